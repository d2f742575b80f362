"""G-buffers: the per-pixel attributes of one view, from EXR files of any renderer."""

from deepshade.gbuffer.load import GBuffer, Source, load_gbuffer, load_gbuffers, source_name

__all__ = ["GBuffer", "Source", "load_gbuffer", "load_gbuffers", "source_name"]
