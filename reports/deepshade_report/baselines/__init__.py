"""The rivals that take part here, and which are missing, with the reason."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from deepshade.errors import DeepshadeError
from deepshade.extras import extra_of
from deepshade_report.method import Method

# What a page calls them -> the module, whose `methods(quick)` gives one Method for each of its
# settings (in a quick report, few). A Method that traces the scene itself, and so can't shade a
# frame that was continued beyond the rendered one, says so by `needs_scene = True`.
MODULES = {
    "HBAO": "deepshade_report.baselines.ao.hbao",
    "GTAO": "deepshade_report.baselines.ao.gtao",
    "ray tracing with a denoiser": "deepshade_report.baselines.ao.raytracing",
}


def rivals(quick: bool) -> tuple[list[Method], dict[str, str]]:
    """All rivals with their settings, and the names of those that are missing, with the reason."""
    found: list[Method] = []
    missing: dict[str, str] = {}
    for name, module in MODULES.items():
        if find_spec(module) is None:
            missing[name] = "not in this installation"
            continue
        try:
            found += import_module(module).methods(quick)
        except ModuleNotFoundError as error:
            extra = extra_of(error.name or "")
            fix = f"; pip install 'deepshade[{extra}]'" if extra else ""
            missing[name] = f"no module '{error.name}'{fix}"
        except DeepshadeError as error:
            missing[name] = f"{error} {error.fix}".strip()
    return found, missing


def needs_scene(method: Method) -> bool:
    """Whether the method traces the scene itself."""
    return bool(getattr(method, "needs_scene", False))
