"""What motion blur is compared with: reconstruction filters along the dominant motion."""

METHODS = {"McGuire": "mcguire", "Jimenez": "jimenez"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (58.0, 0.916)
