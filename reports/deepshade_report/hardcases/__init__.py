"""Hard cases, as one table: case x effect x engine x precision (`deepshade hardcases`)."""
