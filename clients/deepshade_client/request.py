"""Building a request and reading its response; what the sync and the async client share."""

from __future__ import annotations

import email.utils
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import quote

import httpx
import numpy as np
from numpy.typing import ArrayLike

from deepshade_client.answer import Answer, Saved, facts, timing
from deepshade_client.exceptions import (
    BadAnswer,
    ClientError,
    ConnectionBroken,
    ConnectionFailed,
    TimedOut,
    TransportError,
    problem,
)

EXR = "image/x-exr"
PNG = "image/png"

T = TypeVar("T")

Source = Path | str | bytes
Picture = Source | Sequence[Source] | Mapping[str, Source]
Effects = str | Sequence[str]  # "ao", "ao,gi" or ["ao", "gi"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What a shading request may ask for; None leaves it to the service.

    `radius`, `focus` and `aperture` are in scene units, `shutter` in frames, `fov` is the full
    horizontal angle in degrees. `radius` may be a share of the median depth, "15%", which it is
    without one. `projection` is the camera's, where it isn't perspective; an orthographic frame is
    `ortho_width` scene units wide. `view` is one of a stereo file, or a part of a file, by name.
    `world_to_camera` is the camera's matrix (4, 4), for column vectors, or its numbers
    row by row as text. `mapping` says which layer or comma-separated channels hold an
    attribute, `half` asks for 16-bit pixels. `environment` names the map that lights the scene,
    `rotate` turns it, in degrees, and `up` is the world's up axis.

    How the values are stored, where the service doesn't find it out: `axes` as in
    "position:x,-y,-z" or "opencv", `normals`, the kind of `depth` with the `near` and `far` plane
    where it needs them, and what to `derive` though it is there. `strict` makes warnings errors,
    `trust` skips the checks.

    What the answer holds: with `append` the picture's own channels too, and the answer as a layer;
    `layer` names that ("AO"); with `multiply` the picture's beauty times the answer.

    What shades: `quality` ("fast", "balanced", "best") or `bundle` by name; `max_error` (DSSIM)
    asks for the fastest within an error, `budget_ms` for the most accurate within a time of the
    network; `engine` ("openvino") and `precision` ("bf16") pin how it runs.
    """

    radius: float | str | None = None
    focus: float | None = None
    aperture: float | None = None
    shutter: float | None = None
    environment: str | None = None
    rotate: float | None = None
    up: Literal["y", "z"] | None = None
    fov: float | None = None
    projection: Literal["perspective", "orthographic", "latlong"] | None = None
    ortho_width: float | None = None
    view: str | None = None
    world_to_camera: ArrayLike | str | None = None
    profile: str | None = None
    mapping: Mapping[str, str] | None = None
    axes: Sequence[str] | None = None
    normals: Literal["signed", "encoded", "scaled"] | None = None
    depth: str | None = None
    near: float | None = None
    far: float | None = None
    derive: Sequence[str] | None = None
    strict: bool | None = None
    trust: bool | None = None
    bundle: str | None = None
    quality: str | None = None
    max_error: float | None = None
    budget_ms: float | None = None
    engine: str | None = None
    precision: str | None = None
    format: Literal["exr", "png"] | None = None
    compression: str | None = None
    half: bool | None = None
    append: bool | None = None
    layer: str | None = None
    multiply: bool | None = None

    def query(self) -> list[tuple[str, str]]:
        """As the parameters of the request."""
        matrix = self.world_to_camera
        if matrix is not None and not isinstance(matrix, str):
            matrix = ",".join(f"{number:.17g}" for number in np.asarray(matrix, float).flat)
        plain = asdict(replace(self, mapping=None, axes=None, derive=None, world_to_camera=matrix))
        mapped = [("map", f"{name}={where}") for name, where in (self.mapping or {}).items()]
        mapped += [("axes", axes) for axes in self.axes or ()]
        mapped += [("derive", name) for name in self.derive or ()]
        return [(name, _text(value)) for name, value in plain.items() if value is not None] + mapped


def shade_request(
    effects: Effects, picture: Picture, options: Options | None, *, explain: bool = False
) -> dict[str, Any]:
    """The arguments of httpx's `request`; reads the files. With `explain` it asks for the plan.

    One file is sent as the body, several as a form. Raises OSError for a file that can't be read.
    """
    query = (options or Options()).query()
    if explain:
        query.append(("explain", "true"))
    names = effects if isinstance(effects, str) else ",".join(effects)
    request = {"method": "POST", "url": f"shade/{quote(names, safe=',')}", "params": query}
    if isinstance(picture, (str, bytes, Path)):
        name, data = _named(picture)
        headers = {"Content-Type": EXR}
        if re.fullmatch(r"[\w. #%+-]+", name, re.ASCII):  # what any header may hold
            headers["Content-Disposition"] = f'attachment; filename="{name}"'
        return request | {"content": data, "headers": headers}
    named = picture.items() if isinstance(picture, Mapping) else [("image", s) for s in picture]
    files = [(field, (*_named(source), EXR)) for field, source in named]
    return request | {"files": files}


def read_answer(response: httpx.Response) -> Answer:
    """The picture of a response. Raises ServerProblem, BadAnswer."""
    return Answer(response.content, *_described(response))


def read_saved(response: httpx.Response, path: Path) -> Saved:
    """The same for a picture whose bytes go to a file; those of a problem must have been read."""
    return Saved(path, *_described(response))


def _described(response: httpx.Response) -> tuple[str, dict[str, str], dict[str, float]]:
    """(media type, facts, timing) of a response that holds a picture."""
    check(response)
    media_type = response.headers.get("content-type", "").partition(";")[0]
    if media_type not in (EXR, PNG):
        raise BadAnswer(f"the answer is '{media_type}', not a picture")
    headers = response.headers
    return media_type, facts(headers), timing(headers.get("server-timing", ""))


def base_url(server: str) -> httpx.URL:
    """The address that requests go below. Raises ClientError for what is none."""
    try:
        url = httpx.URL(server + "/")
        if url.scheme not in ("http", "https") or not url.host:
            raise ValueError("it must begin with http:// or https://")
    except (httpx.InvalidURL, ValueError) as error:
        raise ClientError(
            f"'{server}' is no address of a service: {error}",
            fix="write it like http://127.0.0.1:8000",
        ) from None
    return url


def environment_request(name: str, source: Source) -> dict[str, Any]:
    """The arguments of httpx's `request` that add an environment map; reads the file."""
    url = f"environments/{quote(name, safe='')}"
    headers = {"Content-Type": "application/octet-stream"}
    return {"method": "POST", "url": url, "content": _named(source)[1], "headers": headers}


def get_request(*path: str) -> dict[str, Any]:
    """The arguments of httpx's `request` for something to look up."""
    return {"method": "GET", "url": "/".join(quote(step, safe="") for step in path)}


def read_list(response: httpx.Response) -> list[dict[str, Any]]:
    """A list of objects, such as effects. Raises ServerProblem, BadAnswer."""
    return _json(response, list)


def read_object(response: httpx.Response) -> dict[str, Any]:
    """One object, such as an effect. Raises ServerProblem, BadAnswer."""
    return _json(response, dict)


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _json(response: httpx.Response, kind: type[T]) -> T:
    check(response)
    try:
        document = response.json()
    except ValueError as error:
        raise BadAnswer("the answer is no JSON; is this a deepshade service?") from error
    if not isinstance(document, kind):
        raise BadAnswer(f"the answer is no JSON {kind.__name__}; is this a deepshade service?")
    return document


# what balancers answer when a service that they had chosen goes away (Ray Serve: 500)
_LOST = (500, 502, 504)


def check(response: httpx.Response) -> None:
    """Raises the exception for a response that isn't a success."""
    if response.is_success:
        return
    try:
        document = response.json()
    except ValueError:
        document = None
    if not isinstance(document, dict):
        # Not from the service: a proxy in between, or something else at that address.
        said = f"HTTP {response.status_code} {response.reason_phrase}".strip()
        if response.status_code in _LOST:
            raise ConnectionBroken(f"what is in front of the service answers {said}")
        document = {"detail": said}
    raise problem(response.status_code, document, _retry_after(response))


def transport_error(error: httpx.HTTPError, server: str) -> ClientError:
    """Our exception for one of httpx's."""
    if isinstance(error, httpx.ConnectTimeout | httpx.ConnectError):
        return ConnectionFailed(f"can't connect to {server}: {error}")
    if isinstance(error, httpx.TimeoutException):
        return TimedOut(f"{server} did not answer in time")
    if isinstance(error, httpx.NetworkError | httpx.RemoteProtocolError):
        return ConnectionBroken(f"the connection to {server} broke: {error}")
    return TransportError(f"the request to {server} failed: {error}")


def _named(source: Source) -> tuple[str, bytes]:
    if isinstance(source, bytes):
        return "image.exr", source
    path = Path(source)
    return path.name, path.read_bytes()


def _retry_after(response: httpx.Response) -> float | None:
    """Seconds, from a number or an HTTP date."""
    value = response.headers.get("retry-after", "")
    with suppress(ValueError):
        return max(0.0, float(value))
    with suppress(ValueError):
        return max(0.0, email.utils.parsedate_to_datetime(value).timestamp() - time.time())
    return None
