"""The pages and what they load: static files of this package, which run nothing but themselves."""

from __future__ import annotations

import hashlib
from importlib.resources import files

from fastapi import FastAPI, Request, Response

from deepshade_service.problems import Problem

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}

# Nothing inline and nothing from elsewhere; pictures also from blobs, which the page makes itself.
_SAFE = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self';"
    " img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",  # asked for each time, and sent only when it has changed
}


def install(app: FastAPI) -> None:
    """Add the routes to `app`. The files are read once, so no request reaches the disk."""
    found = {
        entry.name: entry.read_bytes()
        for entry in files("deepshade_service").joinpath("page").iterdir()
        if entry.name[entry.name.rfind(".") :] in _TYPES
    }
    tags = {name: f'"{hashlib.sha256(data).hexdigest()[:32]}"' for name, data in found.items()}

    def send(name: str, request: Request) -> Response:
        headers = {**_SAFE, "ETag": tags[name]}
        if request.headers.get("if-none-match") == tags[name]:
            return Response(status_code=304, headers=headers)
        kind = _TYPES[name[name.rfind(".") :]]
        return Response(found[name], headers={**headers, "Content-Type": kind})

    @app.get("/", include_in_schema=False)
    async def index(request: Request) -> Response:
        return send("index.html", request)

    @app.get("/live/{session}", include_in_schema=False)
    async def live(session: str, request: Request) -> Response:
        return send("live.html", request)  # which says so where there is no such session

    @app.get("/page/{name}", include_in_schema=False)
    async def part(name: str, request: Request) -> Response:
        if name not in found:
            raise Problem(404, "not-found", f"the page has no part '{name[:100]}'")
        return send(name, request)
