"""The optional parts of deepshade: which packages each needs."""

from __future__ import annotations

import importlib.util

# extra -> (name to import, name to install)
EXTRAS: dict[str, tuple[tuple[str, str], ...]] = {
    "client": (("httpx", "httpx"), ("websockets", "websockets")),
    "service": (
        ("fastapi", "fastapi"),
        ("uvicorn", "uvicorn"),
        ("httptools", "httptools"),
        ("onnxruntime", "onnxruntime"),
        ("openvino", "openvino"),
        ("python_multipart", "python-multipart"),
        ("prometheus_client", "prometheus-client"),
        ("PIL", "pillow"),
    ),
    "workers": (
        ("ray", "ray"),
        ("mitsuba", "mitsuba"),
        ("trimesh", "trimesh"),
        ("scipy", "scipy"),
        ("PIL", "pillow"),
        ("safetensors", "safetensors"),
    ),
    "trainer": (
        ("torch", "torch"),
        ("onnx", "onnx"),
        ("onnxscript", "onnxscript"),
        ("onnxruntime", "onnxruntime"),
        ("openvino", "openvino"),
        ("safetensors", "safetensors"),
        ("tensorboard", "tensorboard"),
        ("flip_evaluator", "flip-evaluator"),
        ("PIL", "pillow"),
    ),
    "report": (
        ("matplotlib", "matplotlib"),
        ("jinja2", "jinja2"),
        ("safetensors", "safetensors"),
        ("mitsuba", "mitsuba"),
        ("mitsuba_oidn", "mitsuba-oidn"),
        ("torch", "torch"),
    ),
}
# imported by a package above rather than by us
_INDIRECT = {"drjit": "workers", "starlette": "service", "pydantic": "service"}


def installed(module: str) -> bool:
    """Whether a top-level module could be imported; it isn't."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def missing_packages(extra: str) -> list[str]:
    """The packages of an extra that aren't installed, by their names for pip."""
    return [package for module, package in EXTRAS[extra] if not installed(module)]


def extra_of(module: str) -> str | None:
    """The first extra that brings a module, or None if it is nobody's."""
    top = module.partition(".")[0]
    for extra, packages in EXTRAS.items():
        if any(top == name for name, _ in packages):
            return extra
    return _INDIRECT.get(top)
