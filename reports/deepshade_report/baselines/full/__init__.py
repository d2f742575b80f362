"""What full shading is compared with: the chain of what engines have for its parts."""

METHODS = {"split sum + GTAO + ring gather": "chain"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (97.0, 0.667)
