"""A bundle's network calculated in float64, beside which engines and precisions are judged."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from deepshade.bundles import Bundle
from deepshade.engines import Backend, Engine
from deepshade.engines.base import Float
from deepshade_trainer.networks import from_bundle

FLOAT64 = Backend("pytorch", "float64")
# Where the CPU has no 16 bits of its own: what they cost, though not what they spare.
ROUNDED = Backend("pytorch", "bf16")


class _Torch(Engine):
    """The network as the trainer has it, with the bundle's weights.

    What it is given and what it answers are float32, as for any engine. Answers are kept by what
    they were asked for: many cases come to the same input.
    """

    def __init__(self, bundle: Bundle, backend: Backend) -> None:
        super().__init__(bundle, backend, threads=torch.get_num_threads())
        self.shader = from_bundle(bundle.path)
        self._known: dict[bytes, Float] = {}

    def predict(self, gbuffer: Float, environment: Mapping[str, Float] | None = None) -> Float:
        """See `Engine.predict`."""
        given = [(environment or {})[name] for name in self.bundle.environment]
        digest = hashlib.sha256(str(gbuffer.shape).encode())
        for array in (gbuffer, *given):
            digest.update(np.ascontiguousarray(array).tobytes())
        if (found := self._known.get(digest.digest())) is None:
            with torch.inference_mode():
                tensors = [torch.from_numpy(np.ascontiguousarray(a)) for a in (gbuffer, *given)]
                answer = self.answer(tensors)
            with np.errstate(over="ignore"):
                found = answer.numpy().astype(np.float32)
            self._known[digest.digest()] = found
        return found.copy()

    def shrink(self) -> None:
        """See `Engine.shrink`."""
        self._known.clear()

    @abstractmethod
    def answer(self, given: list[Tensor]) -> Tensor:
        """The shader's, to the G-buffer and what comes after it."""


class Float64(_Torch):
    """Every step in float64."""

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle, FLOAT64)
        self.shader.double()

    def answer(self, given: list[Tensor]) -> Tensor:
        """See `_Torch.answer`."""
        with stay64():
            answer: Tensor = self.shader(*(each.double() for each in given))
        if answer.dtype != torch.float64:
            raise TypeError(f"a step of {self.bundle.effect}'s network was in {answer.dtype}")
        return answer


class Rounded(_Torch):
    """Convolutions of 16 bits, where the trainer has them so (`full_precision` says where not)."""

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle, ROUNDED)

    def answer(self, given: list[Tensor]) -> Tensor:
        """See `_Torch.answer`."""
        with torch.autocast("cpu", torch.bfloat16):
            answer: Tensor = self.shader(*given)
        return answer.float()


@contextmanager
def stay64() -> Iterator[None]:
    """Networks stay in float64 inside, the constants that they make too."""
    usual = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with _Stay64():
            yield
    finally:
        torch.set_default_dtype(usual)


class _Stay64(TorchFunctionMode):
    """Networks return to float32 after what may be calculated in 16 bits; here to float64."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.Tensor.float:
            return args[0].double()
        return func(*args, **(kwargs or {}))
