"""Scenes: meshes with materials, from files or from a seed, ready for ray tracing."""
