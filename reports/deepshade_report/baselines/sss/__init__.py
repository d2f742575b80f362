"""What subsurface scattering is compared with: importance-sampled and separable diffusion."""

METHODS = {"Burley, importance-sampled": "burley", "separable": "separable"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (21.0, 0.905)
