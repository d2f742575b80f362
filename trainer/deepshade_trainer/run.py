"""The files of a training run, all in one place: an existing folder means resume."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from deepshade.errors import DataError
from deepshade.files import replacing

Tensors = dict[str, Tensor]


@dataclass(frozen=True)
class Run:
    """A run's folder: recipe, checkpoint, metrics, a preview, and TensorBoard's `log/`."""

    folder: Path

    @property
    def recipe(self) -> Path:
        """The settings it was begun with."""
        return self.folder / "recipe.json"

    @property
    def checkpoint(self) -> Path:
        """Weights, their average, the optimizer's state and the step, in one atomic file."""
        return self.folder / "checkpoint.safetensors"

    @property
    def metrics(self) -> Path:
        """Validation figures, one entry each time."""
        return self.folder / "metrics.json"

    @property
    def preview(self) -> Path:
        """The last validation's first views: ours, the reference, the error."""
        return self.folder / "preview.png"

    @property
    def log(self) -> Path:
        """TensorBoard's folder."""
        return self.folder / "log"

    def save(self, groups: dict[str, Tensors], step: int, optimizer: dict[str, Any]) -> None:
        """Replace the checkpoint: named groups of tensors, and the optimizer's state.

        The state's tensors are stored as tensors and the rest as JSON; nothing is pickled.
        """
        flat = {f"{group}/{name}": t for group, ts in groups.items() for name, t in ts.items()}
        for index, state in optimizer["state"].items():
            for key, value in state.items():
                flat[f"optimizer/{index}/{key}"] = torch.as_tensor(value)
        flat = {name: tensor.detach().cpu().contiguous() for name, tensor in flat.items()}
        meta = {"step": str(step), "groups": json.dumps(optimizer["param_groups"])}
        with replacing(self.checkpoint) as temporary:
            temporary.write_bytes(save(flat, meta))

    def load(self) -> tuple[dict[str, Tensors], int, dict[str, Any]]:
        """What `save` stored: groups, step, optimizer state.

        Raises:
            DataError: the checkpoint is damaged.
        """
        groups: dict[str, Tensors] = {}
        state: dict[int, dict[str, Any]] = {}
        try:
            with safe_open(self.checkpoint, framework="pt") as file:
                meta = file.metadata()
                for name in file.keys():  # noqa: SIM118 (not a dict)
                    group, rest = name.split("/", 1)
                    tensor = file.get_tensor(name)
                    if group == "optimizer":
                        index, key = rest.split("/", 1)
                        state.setdefault(int(index), {})[key] = tensor
                    else:
                        groups.setdefault(group, {})[rest] = tensor
        except Exception as error:
            raise DataError(
                f"{self.checkpoint} can't be read: {error}", fix="remove it to begin anew"
            ) from error
        optimizer = {"state": state, "param_groups": json.loads(meta["groups"])}
        return groups, int(meta["step"]), optimizer
