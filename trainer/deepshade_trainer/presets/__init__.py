"""What differs from the defaults of `Recipe`: a file for each effect, found by its name."""
