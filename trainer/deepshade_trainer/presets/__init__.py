"""What differs from the defaults of `Recipe`: a file for each effect, found by its name.

A preset whose network is calculated can't be trained: `calculated` writes its bundle.
"""
