"""The shared language of deepshade: effects, attributes, G-buffers, EXR, metrics, bundles."""
