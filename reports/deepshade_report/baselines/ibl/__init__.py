"""What image-based lighting is compared with: harmonics and a prefiltered mip chain."""

METHODS = {"split sum": "splitsum"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (28.0, 0.796)
