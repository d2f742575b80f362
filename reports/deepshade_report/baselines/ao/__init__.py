"""What ambient occlusion is compared with: HBAO, GTAO, denoised ray tracing."""

METHODS = {"HBAO": "hbao", "GTAO": "gtao", "ray tracing with a denoiser": "raytracing"}
# Nalbach et al. 2017, table 1: milliseconds at 768 x 512 on a GTX 980 Ti, SSIM on its own test set
PUBLISHED = (17.0, 0.729)
