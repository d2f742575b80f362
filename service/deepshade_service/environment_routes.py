"""The routes of environment maps: list them, look at them, add one."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI, Request, Response

from deepshade_service.config import Settings
from deepshade_service.described import errors
from deepshade_service.environments import Environments
from deepshade_service.problems import Problem
from deepshade_service.uploads import RAW_TYPES, Uploads

_BINARY = {"type": "string", "format": "binary"}
_BODY = {"required": True, "content": {kind: {"schema": _BINARY} for kind in RAW_TYPES}}


def install(app: FastAPI, environments: Environments, uploads: Uploads, settings: Settings) -> None:
    """Add the routes to `app`."""

    @app.get(
        "/environments",
        tags=["environments"],
        summary="All environment maps",
        responses=errors({}),
    )
    async def listed() -> list[dict[str, Any]]:
        """Names for `?environment=`; `sky` is generated. Hash and size once a map has been used."""
        return [environments.describe(name) for name in environments.names()]

    @app.get(
        "/environments/{name}/thumbnail",
        tags=["environments"],
        summary="A small picture of a map",
        response_class=Response,
        responses={
            200: {"content": {"image/png": {"schema": _BINARY}}},
            **errors({404: "There is no such map", 422: "Its file can't be used"}),
        },
    )
    async def thumbnail(name: str) -> Response:
        return Response(await environments.thumbnail(name), media_type="image/png")

    @app.post(
        "/environments/{name}",
        tags=["environments"],
        summary="Add a map, or replace the one of that name",
        status_code=201,
        openapi_extra={"requestBody": _BODY},
        responses=errors({422: "No such map can be used"}, uploads=True),
    )
    async def add(name: str, request: Request) -> dict[str, Any]:
        """The body is a latitude-longitude EXR or Radiance HDR. Only where the operator allows it
        (`deepshade serve --allow-environment-uploads`)."""
        if not settings.environment_uploads:
            raise Problem(
                403,
                "not-allowed",
                "this service takes no environment maps",
                fix="start it with --environments DIR --allow-environment-uploads",
            )
        async with uploads.receive(request) as files:
            if len(files) != 1:
                raise Problem(422, "bad-parameter", f"{len(files)} files came, not one map")
            return await environments.add(name, files[0].data)
