"""What indirect light is compared with: the visibility bitmask."""

METHODS = {"visibility bitmask": "bitmask", "marched rays": "onelayer"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (60.0, 0.798)
