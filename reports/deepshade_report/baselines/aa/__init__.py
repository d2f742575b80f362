"""What anti-aliasing is compared with: filters that look for edges in the picture."""

METHODS = {"FXAA": "fxaa", "CMAA2": "cmaa2", "SMAA": "smaa"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (3.8, 0.982)
