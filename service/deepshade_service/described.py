"""What the OpenAPI document says of errors: every one is a problem document."""

from __future__ import annotations

from typing import Any

from deepshade.problems import MEDIA_TYPE

_PROBLEM = {
    "type": "object",
    "required": ["type", "title", "status", "detail"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "fix": {"type": "string"},
    },
}
_ANYWHERE = {421: "Asked for by a name that isn't the service's; see --allow-host"}
_UPLOADS = {
    400: "No EXR, or a damaged one",
    403: "A page of another origin asks (--allow-origin), or the operator doesn't allow it",
    408: "The body arrived too slowly",
    413: "Over a limit",
    415: "Another content type",
    429: "Too much is held or waits already; see Retry-After",
}


def errors(statuses: dict[int, str], *, uploads: bool = False) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that may answer these, and what any may, or any with a body."""
    every = _ANYWHERE | (_UPLOADS if uploads else {}) | statuses
    return {
        status: {"description": text, "content": {MEDIA_TYPE: {"schema": _PROBLEM}}}
        for status, text in sorted(every.items())
    }
