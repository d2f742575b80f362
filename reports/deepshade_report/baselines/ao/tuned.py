"""The parameters of HBAO and GTAO that the sweep in `tuning` found, as they are shipped."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from deepshade.errors import DeepshadeError


def parameters(method: str) -> dict[str, Any]:
    """The tuned parameters of 'hbao' or 'gtao', by name; none where there is no such file.

    Raises DeepshadeError for a damaged file.
    """
    source = files("deepshade_report") / "baselines/ao/tuned.json"
    if not source.is_file():
        return {}
    try:
        found: dict[str, Any] = json.loads(source.read_text("utf-8"))[method]["parameters"]
        return dict(found)
    except (ValueError, KeyError, TypeError) as error:
        raise DeepshadeError(
            f"{source} is damaged: {error!r}",
            fix="tune again: python -m deepshade_report.baselines.ao.tuning --help",
        ) from error
