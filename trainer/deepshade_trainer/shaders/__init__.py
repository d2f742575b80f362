"""A bundle's graph as shader programs: a list of passes over a dozen small kernels."""

from deepshade_trainer.shaders.languages import LANGUAGES
from deepshade_trainer.shaders.writing import write_shaders

__all__ = ["LANGUAGES", "write_shaders"]
