"""What ambient occlusion is compared with: HBAO, GTAO, denoised ray tracing."""
