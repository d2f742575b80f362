"""What an effect's networks are compared with: hand-written methods, in a folder an effect."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from deepshade.errors import DeepshadeError
from deepshade.extras import extra_of, install_command
from deepshade_report.method import SCREEN_SPACE, Method


def folder(effect: str) -> ModuleType | None:
    """The package of an effect's baselines, None where it has none.

    Its METHODS map what a page calls them to modules, whose `methods(quick)` gives one Method for
    each setting (in a quick report, few). A Method that traces the scene itself, and so can't shade
    a frame that was continued beyond the rendered one, has `needs_scene = True`. A module whose
    method has parameters offers them to `tuning` as TUNABLE. PUBLISHED are the paper's own
    (milliseconds at 768 x 512, SSIM), if there.
    """
    name = f"{__name__}.{effect}"
    return import_module(name) if find_spec(name) else None


def baselines(
    effect: str, quick: bool, threads: int | None = None
) -> tuple[list[Method], dict[str, str]]:
    """All baselines of an effect, and the names of those that are missing, with the reason.

    Compiled kernels run in `threads` threads, as many as networks are given; None: all there are.
    """
    found: list[Method] = []
    missing: dict[str, str] = {}
    for name, module in getattr(folder(effect), "METHODS", {}).items():
        try:
            found += import_module(f"{__name__}.{effect}.{module}").methods(quick)
        except ModuleNotFoundError as error:
            extra = extra_of(error.name or "")
            fix = f"; {install_command(extra)}" if extra else ""
            missing[name] = f"no module '{error.name}'{fix}"
        except DeepshadeError as error:
            missing[name] = f"{error} {error.fix}".strip()
    if threads and any(method.family == SCREEN_SPACE for method in found):
        import drjit

        drjit.set_thread_count(threads)
    return found, missing
