"""What subsurface scattering is compared with: importance-sampled and separable diffusion.

To tune: `python -m deepshade_report.tuning --effect sss --data DATA --out tuned.json`, on views
apart from those that are reported; the result belongs beside this file.
"""

METHODS = {"Burley, importance-sampled": "burley", "separable": "separable"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (21.0, 0.905)
