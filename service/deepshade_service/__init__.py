"""The HTTP service that shades G-buffers."""
