"""Who imports whom: no cycles, not even hidden in functions, and the parts keep apart."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PARTS = {
    "core": "deepshade",
    "service": "deepshade_service",
    "workers": "deepshade_workers",
    "trainer": "deepshade_trainer",
    "clients": "deepshade_client",
    "reports": "deepshade_report",
}
HEAVY = {"torch", "ray", "mitsuba", "drjit", "trimesh", "fastapi", "openvino", "onnxruntime"}


def modules() -> dict[str, Path]:
    """Every module of the project, by its dotted name."""
    found = {}
    for folder, package in PARTS.items():
        for path in (ROOT / folder / package).rglob("*.py"):
            name = ".".join(path.relative_to(ROOT / folder).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


MODULES = modules()


def imported(path: Path, *, top: bool = False) -> set[str]:
    """What a module imports, at its top or anywhere; not what only type checkers read."""
    tree = ast.parse(path.read_text())
    guarded = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    found: set[str] = set()
    for node in tree.body if top else ast.walk(tree):
        if id(node) in guarded:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert not node.level, f"{path}: relative import"
            inside = {f"{node.module}.{alias.name}" for alias in node.names} & MODULES.keys()
            # a package's submodule is imported through the package, which is no use of it
            found |= inside or {node.module}
    return found


def test_no_module_imports_itself_in_the_end():
    graph = {name: imported(path) & MODULES.keys() for name, path in MODULES.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(reversed(error.args[1])))


@pytest.mark.parametrize("part", PARTS.values())
def test_parts_import_core_alone(part):
    for name, path in MODULES.items():
        if name.split(".")[0] != part or part == "deepshade_report":
            continue
        others = {module.split(".")[0] for module in imported(path)} & set(PARTS.values())
        assert others <= {part, "deepshade"}, name


def test_core_names_no_heavy_library_at_its_top():
    for name, path in MODULES.items():
        if name.split(".")[0] in ("deepshade", "deepshade_client"):
            heavy = {module.split(".")[0] for module in imported(path, top=True)} & HEAVY
            assert not heavy, name


def test_the_service_never_imports_what_renders_or_trains():
    for name, path in MODULES.items():
        if name == "deepshade_service.scaling":  # what Ray Serve imports, and nobody else
            assert not any(name in imported(other) for other in MODULES.values())
        elif name.split(".")[0] == "deepshade_service":
            heavy = {module.split(".")[0] for module in imported(path)}
            assert heavy.isdisjoint({"torch", "ray", "mitsuba"}), name


def test_no_file_but_its_own_names_an_effect():
    """Adding an effect is adding files. `ao` is what commands fall back to, and may be named."""
    from deepshade.effects import EFFECTS

    words = set(EFFECTS) - {"ao", "full"}  # "full" is a word of its own
    for name, path in MODULES.items():
        own = path.stem in EFFECTS or any(parent.name in EFFECTS for parent in path.parents)
        if own:
            continue
        constants = {
            node.value
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        assert constants.isdisjoint(words), name
