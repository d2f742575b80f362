"""What depth of field is compared with: a ring gather with a near layer, and marched rays."""

METHODS = {"ring gather": "rings", "marched rays": "onelayer"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (21.0, 0.848)
