"""Networks, losses, training, evaluation and export of shaders."""
