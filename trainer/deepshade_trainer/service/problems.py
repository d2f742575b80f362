"""Every error as an RFC 9457 problem document: what was wrong, where, and what to do."""

from __future__ import annotations

import logging
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from deepshade.errors import BundleError, DeepshadeError
from deepshade.problems import MEDIA_TYPE, facts_of, kind_of, type_uri

log = logging.getLogger("deepshade.trainer")


def respond(
    status: int, kind: str, detail: str, fix: str = "", retry: int = 0, **more: object
) -> JSONResponse:
    """A problem as a response; `retry` are the seconds of Retry-After."""
    document = {"type": type_uri(kind), "title": HTTPStatus(status).phrase, "status": status}
    document |= {"detail": detail, **({"fix": fix} if fix else {}), **more}
    headers = {"Retry-After": str(retry)} if retry else None
    return JSONResponse(document, status_code=status, media_type=MEDIA_TYPE, headers=headers)


class Problem(Exception):
    """A problem that the service itself finds."""

    def __init__(self, status: int, kind: str, detail: str, fix: str = "", retry: int = 0) -> None:
        super().__init__(detail)
        self.response = respond(status, kind, detail, fix, retry)


def install(app: FastAPI) -> None:
    """Make `app` answer errors as problem documents."""

    @app.exception_handler(Problem)
    async def _(request: Request, error: Problem) -> JSONResponse:
        return error.response

    @app.exception_handler(DeepshadeError)
    async def _(request: Request, error: DeepshadeError) -> JSONResponse:
        status, kind = kind_of(error)
        if isinstance(error, BundleError):  # here it's the request that names bundles
            status = 422
        return respond(status, kind, str(error), error.fix, **facts_of(error))

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> JSONResponse:
        kind = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")
        detail = f"{request.method} {request.url.path}: {error.detail}"
        fix = "see /docs for what there is" if error.status_code in (404, 405) else ""
        return respond(error.status_code, kind, detail, fix)

    @app.exception_handler(RequestValidationError)
    async def _(request: Request, error: RequestValidationError) -> JSONResponse:
        said = [
            f"{'.'.join(str(step) for step in entry['loc'][1:]) or 'the body'}: "
            + str(entry["msg"]).removeprefix("Value error, ")
            for entry in error.errors()
        ]
        fix = "/docs lists what there is, with its range"
        return respond(422, "bad-parameter", "; ".join(said), fix)

    @app.exception_handler(SQLAlchemyError)
    async def _(request: Request, error: SQLAlchemyError) -> JSONResponse:
        log.error("the database fails: %s", error)
        detail = "the trainer's database can't be asked just now"
        return respond(503, "not-ready", detail, "try again in a moment", retry=2)

    @app.exception_handler(Exception)
    async def _(request: Request, error: Exception) -> JSONResponse:
        # The traceback goes to the log (the server writes it); the client learns only this.
        detail = "the service failed on this request; its log has the details"
        return respond(500, "internal", detail, "report it with the request that caused it")
