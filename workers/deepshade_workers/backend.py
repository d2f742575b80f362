"""Mitsuba, in the variant that this machine can run."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from deepshade.errors import DeepshadeError
from deepshade.llvm import FIX, find_libllvm


@functools.cache
def mitsuba() -> Any:
    """Import Mitsuba and set its variant: `cuda_ad_rgb` where there is a GPU, else `llvm_ad_rgb`.

    Raises:
        DeepshadeError: there is neither an NVIDIA GPU nor a usable libLLVM, or Mitsuba's own
            libraries lack another one (libatomic, where Debian is small).
    """
    library = find_libllvm()
    if library is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(library))
    try:
        import drjit as dr
        import mitsuba as mi
    except (ImportError, NameError) as error:  # Dr.Jit goes on to a NameError
        raise DeepshadeError(
            f"Mitsuba can't be loaded: {error.__context__ or error}",
            fix="sudo apt-get install libatomic1, if that is the library; or pip install "
            "--force-reinstall mitsuba",
        ) from error
    gpu = dr.has_backend(dr.JitBackend.CUDA)
    if library is None and not gpu:
        raise DeepshadeError(
            "Mitsuba's llvm_ad_rgb variant needs libLLVM 17 or newer, and none was found",
            fix=FIX,
        )
    mi.set_variant("cuda_ad_rgb" if gpu else "llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    return mi


@contextmanager
def two_threads() -> Iterator[None]:
    """At least two threads of Dr.Jit, to read and write EXR files with.

    Mitsuba gives what is in them to the other threads; where there is none it waits for ever.
    """
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(max(2, before))
    try:
        yield
    finally:
        dr.set_thread_count(before)
