"""Every error as an RFC 9457 problem document: what was wrong, where, and what to do."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from deepshade.errors import DeepshadeError, EngineError, LimitError, nearest
from deepshade.problems import MEDIA_TYPE, facts_of, kind_of, type_uri

log = logging.getLogger("deepshade.service")

# Which option of `deepshade serve` sets a limit: what its operator can do about it.
_OPTIONS = {
    "body_bytes": "--max-body",
    "decoded_bytes": "--max-decoded",
    "pixels": "--max-pixels",
    "parts": "--max-parts",
    "channels": "--max-channels",
    "files": "--max-files",
    "memory_bytes": "--memory",
    "kept_bytes": "--keep",
}
CLIENT_GONE = 499
_SWITCHES = ("strict", "trust")  # which commands take without a value


class Problem(Exception):
    """A problem that the service itself finds; `kind` ends the document's type URI."""

    def __init__(
        self,
        status: int,
        kind: str,
        detail: str,
        *,
        fix: str = "",
        headers: Mapping[str, str] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.kind = kind
        self.detail = detail
        self.headers = dict(headers or {})
        self.more = {"fix": fix, **more} if fix else more


def from_error(error: DeepshadeError, parameters: Collection[str]) -> Problem:
    """The problem that an error of the core package is, with the facts that it carries.

    Options of commands, which core names, are those of `parameters` here.
    """
    status, kind = kind_of(error)
    fix = error.fix
    if isinstance(error, EngineError):  # what can't run here at all is refused before
        status, kind = 500, "bad-bundle"
    if isinstance(error, LimitError) and error.limit in _OPTIONS:
        option = _OPTIONS[error.limit]
        fix = f"send a smaller picture, or start the service with a higher {option}"
    detail = as_query(str(error), parameters)
    facts = facts_of(error)
    if "fits" in facts:
        facts["fits"] = [as_query(option, parameters) for option in facts["fits"]]
    return Problem(status, kind, detail, fix=as_query(fix, parameters), **facts)


def as_query(text: str, parameters: Collection[str]) -> str:
    """The text with "?fov=50&view=left" for "--fov 50 --view left"."""

    def query(option: re.Match[str]) -> str:
        name = option[1].replace("-", "_")
        value = "1" if name in _SWITCHES else ""
        return f"?{name}={value}" if name in parameters else option[0]

    text = re.sub(r"--([a-z][a-z-]*)(?: (?=[\w<]))?", query, text)
    return re.sub(r"(\?[a-z_]+=[^\s;]*[^\s;,]) \?(?=[a-z_]+=)", r"\1&", text)


def respond(problem: Problem) -> JSONResponse:
    """The problem as a response."""
    return JSONResponse(
        document(problem),
        status_code=problem.status,
        media_type=MEDIA_TYPE,
        headers=problem.headers,
    )


def install(app: FastAPI, parameters: Collection[str]) -> None:
    """Make `app`, whose requests may have these parameters, answer errors as problem documents."""

    @app.exception_handler(Problem)
    async def _(request: Request, error: Problem) -> JSONResponse:
        return respond(error)

    @app.exception_handler(DeepshadeError)
    async def _(request: Request, error: DeepshadeError) -> JSONResponse:
        problem = from_error(error, parameters)
        if problem.status >= 500:
            log.error("%s: %s", request.url.path, error)
        return respond(problem)

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> JSONResponse:
        kind = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")
        detail = f"{request.method} {request.url.path}: {error.detail}"
        fix = "see /docs for what there is" if error.status_code in (404, 405) else ""
        return respond(
            Problem(error.status_code, kind, detail, fix=fix, headers=error.headers or {})
        )

    @app.exception_handler(RequestValidationError)
    async def _(request: Request, error: RequestValidationError) -> JSONResponse:
        return respond(invalid(error.errors(), parameters))

    @app.exception_handler(ClientDisconnect)
    async def _(request: Request, error: ClientDisconnect) -> Response:
        # Nobody reads it, but it is counted, as what nginx calls it, and not as a failure of ours.
        return Response(status_code=CLIENT_GONE)

    @app.exception_handler(Exception)
    async def _(request: Request, error: Exception) -> JSONResponse:
        # The traceback goes to the log (the server writes it); the client learns only this.
        return respond(
            Problem(
                500,
                "internal",
                "the service failed on this request; its log has the details",
                fix="report it with the request that caused it",
            )
        )


def invalid(found: Sequence[Mapping[str, Any]], parameters: Collection[str]) -> Problem:
    """Problem 422 for what pydantic found wrong with parameters, of which there are these."""
    errors = [
        {
            "where": ".".join(str(step) for step in entry["loc"]),
            "problem": _said(entry),
            "got": str(entry.get("input"))[:200],
        }
        for entry in found
    ]
    detail = "; ".join(f"{entry['where']}: {entry['problem']}" for entry in errors)
    fix = "; ".join(filter(None, (_fix(entry, parameters) for entry in found)))
    return Problem(422, "bad-parameter", detail, fix=fix, errors=errors)


def document(problem: Problem) -> dict[str, Any]:
    """The problem document (RFC 9457)."""
    return {
        "type": type_uri(problem.kind),
        "title": HTTPStatus(problem.status).phrase,
        "status": problem.status,
        "detail": problem.detail,
        **problem.more,
    }


def _said(error: Mapping[str, Any]) -> str:
    """What is wrong, where a bound is missed in as few digits as say it."""
    if error["type"] == "extra_forbidden":
        return "there is no such parameter"
    context = error.get("ctx", {})
    for bound, word in (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below")):
        if isinstance(context.get(bound), int | float):
            return f"must be {word} {context[bound]:g}, not {str(error.get('input'))[:40]}"
    return str(error["msg"]).removeprefix("Value error, ")


def _fix(error: Mapping[str, Any], parameters: Collection[str]) -> str:
    """The parameter that may have been meant, or the nearest value that it may have."""
    name = str(error["loc"][-1])
    if error["type"] == "extra_forbidden":
        close = nearest(name[:100], parameters)
        return f"did you mean ?{close}=?" if close else "/docs lists the parameters"
    if error["type"] in ("literal_error", "enum"):
        close = nearest(
            str(error["input"])[:100], re.findall("'([^']+)'", error["ctx"]["expected"])
        )
        return f"did you mean ?{name}={close}?" if close else ""
    for bound in ("ge", "le"):
        if bound in (context := error.get("ctx", {})):
            return f"the nearest is ?{name}={context[bound]:g}"
    return ""
