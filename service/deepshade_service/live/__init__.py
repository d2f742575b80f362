"""Live sessions: a publisher streams G-buffers in, answers stream out to it and to viewers."""
