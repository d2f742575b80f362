"""Passes over buffers of float32: what a graph becomes, whichever language runs it.

A pass runs one kernel, once for each number that it makes. It reads up to three buffers (a, b, c),
writes another, and is told by 64 integers where to find what in them. Weights are buffer 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

NUMBERS = 64  # integers that a pass is told: 256 bytes, what every API lets uniforms start at
GROUP = 64  # invocations of a compute shader that start together
GRID = 16384  # groups in a row of a dispatch; further rows follow, as APIs end at 65535
_RANK = 6  # axes that a kernel walks over at most
WEIGHTS = 0

Ints = Sequence[int]


@dataclass(frozen=True, slots=True)
class View:
    """A part of a buffer by shape and strides, as numpy knows them.

    `array` is of one byte a number and never read: numpy's own slicing, transposing and reshaping
    say where in the buffer what lies.
    """

    buffer: int
    array: NDArray[np.int8]
    start: int  # address of the buffer's first byte

    @classmethod
    def of(cls, buffer: int, shape: Ints) -> View:
        """All of a buffer."""
        array = np.empty(tuple(shape), np.int8)
        return cls(buffer, array, _address(array))

    def turned(self, array: NDArray[np.int8]) -> View:
        """The same buffer by another view of it."""
        return View(self.buffer, array, self.start)

    def reshaped(self, shape: Ints) -> View | None:
        """The same numbers in another shape; None where they would have to move for it."""
        made = self.array.reshape(tuple(shape))
        return self.turned(made) if np.may_share_memory(made, self.array) else None

    @property
    def shape(self) -> tuple[int, ...]:
        """Its sizes."""
        return self.array.shape

    @property
    def strides(self) -> tuple[int, ...]:
        """How many numbers lie between neighbours along each axis."""
        return tuple(
            0 if n == 1 else s for n, s in zip(self.shape, self.array.strides, strict=True)
        )

    @property
    def offset(self) -> int:
        """Where in the buffer its first number is."""
        return _address(self.array) - self.start


def _address(array: NDArray[np.int8]) -> int:
    found: int = array.__array_interface__["data"][0]
    return found


def walk(shape: Ints, operands: Sequence[View]) -> tuple[list[int], list[list[int]]]:
    """The fewest axes that reach the same numbers: their sizes, and each operand's strides.

    Raises ValueError: more than kernels take.
    """
    every = [each.strides for each in operands]
    sizes: list[int] = []
    steps: list[list[int]] = [[] for _ in operands]
    for k, n in enumerate(shape):
        if n == 1:
            continue
        if sizes and all(s and s[-1] == e[k] * n for s, e in zip(steps, every, strict=True)):
            sizes[-1] *= n
            for strides, each in zip(steps, every, strict=True):
                strides[-1] = each[k]
        else:
            sizes.append(n)
            for strides, each in zip(steps, every, strict=True):
                strides.append(each[k])
    if len(sizes) > _RANK:
        raise ValueError(f"{len(sizes)} axes that can't be joined")
    return sizes, steps


@dataclass(slots=True)
class Pass:
    """One kernel's run. Numbers 0 to 7 say where what it makes goes, the others are its own."""

    kernel: str
    target: int
    sources: tuple[int, ...]
    numbers: NDArray[np.int32]

    @classmethod
    def make(
        cls, kernel: str, target: int, count: int, sources: Ints, own: dict[int, int | float]
    ) -> Pass:
        """One that fills the first `count` numbers of the buffer `target`."""
        numbers = np.zeros(NUMBERS, np.int32)
        for at, value in own.items():
            numbers[at] = value if not isinstance(value, float) else bits(value)
        numbers[:4] = count, count, count, 0
        numbers[4] = GRID * GROUP
        return cls(kernel, target, tuple(sources), numbers)

    @property
    def count(self) -> int:
        """How many numbers it makes."""
        return int(self.numbers[0])

    def groups(self, block: int = 1) -> tuple[int, int]:
        """Along x and y, how many groups of a compute shader that makes `block` at once start."""
        groups = -(-self.count // (block * GROUP))
        return min(groups, GRID), -(-groups // GRID)

    @property
    def placed(self) -> bool:
        """Whether what it makes goes between other passes' results."""
        return int(self.numbers[1]) != self.count or bool(self.numbers[3])

    def place(self, target: int, chunk: int, pitch: int, start: int) -> None:
        """Let each `chunk` numbers go to the buffer `target` every `pitch` numbers from `start`."""
        self.target = target
        self.numbers[1:4] = chunk, pitch, start

    def clamp(self, low: float, high: float) -> bool:
        """Let what it makes be clamped; False if it is already."""
        if self.numbers[5]:
            return False
        self.numbers[5:8] = 1, bits(low), bits(high)
        return True


def bits(value: float) -> int:
    """The 32 bits of a float32, as an integer."""
    return int(np.float32(value).view(np.int32))


@dataclass(frozen=True, slots=True)
class Slot:
    """An input or an output: which buffer, of what shape."""

    name: str
    buffer: int
    shape: tuple[int, ...]


@dataclass(slots=True)
class Program:
    """A whole graph: `buffers` are sizes in numbers, of which 0 holds the `weights`."""

    inputs: list[Slot]
    output: Slot
    buffers: list[int]
    passes: list[Pass]
    weights: NDArray[np.float32] = field(repr=False)

    def shared(self) -> Program:
        """The same in fewer buffers: one is used again after its last reader.

        Inputs and weights keep theirs, so that a program may run again and again.
        """
        last = {source: k for k, each in enumerate(self.passes) for source in each.sources}
        last[self.output.buffer] = len(self.passes)
        kept = [WEIGHTS, *(slot.buffer for slot in self.inputs)]
        sizes = [self.buffers[each] for each in kept]
        home = {each: k for k, each in enumerate(kept)}
        free: list[int] = []
        passes = []
        for k, each in enumerate(self.passes):
            if each.target not in home:
                home[each.target] = _take(free, sizes, self.buffers[each.target])
            sources = tuple(home[source] for source in each.sources)
            passes.append(Pass(each.kernel, home[each.target], sources, each.numbers))
            for source in dict.fromkeys((*each.sources, each.target)):
                if last.get(source, -1) <= k and source not in kept:
                    free.append(home[source])
        output = Slot(self.output.name, home[self.output.buffer], self.output.shape)
        inputs = [Slot(slot.name, home[slot.buffer], slot.shape) for slot in self.inputs]
        return Program(inputs, output, sizes, passes, self.weights)


def _take(free: list[int], sizes: list[int], size: int) -> int:
    """A buffer of at least `size`: the smallest that is free, else the largest grown, else new."""
    if not free:
        sizes.append(size)
        return len(sizes) - 1
    fits = [each for each in free if sizes[each] >= size]
    chosen = min(fits, key=sizes.__getitem__) if fits else max(free, key=sizes.__getitem__)
    free.remove(chosen)
    sizes[chosen] = max(sizes[chosen], size)
    return chosen
