"""G-buffers: the per-pixel attributes of one view, from EXR files of any renderer."""

from deepshade.gbuffer.gbuffer import GBuffer
from deepshade.gbuffer.load import load_gbuffer, load_gbuffers
from deepshade.gbuffer.reading import Source, source_name

__all__ = ["GBuffer", "Source", "load_gbuffer", "load_gbuffers", "source_name"]
