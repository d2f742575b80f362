"""Scenes, G-buffer and reference rendering, augmentation, shards and Ray jobs."""
