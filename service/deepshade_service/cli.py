"""`deepshade serve`."""

from __future__ import annotations

import signal
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from deepshade import tracing
from deepshade.machine import share_heaps
from deepshade.serving import listen, logging_config

if TYPE_CHECKING:
    from deepshade_service.config import Settings


LogLevel = Literal["critical", "error", "warning", "info", "debug"]


def serve(
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8000,
    models: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of bundles, <effect>/<name>/, or 'shipped' for those that come with"
            " deepshade; repeatable, the first that has a bundle counts. Default:"
            " $DEEPSHADE_MODELS, else 'shipped'."
        ),
    ] = None,
    environments: Annotated[
        Path | None,
        typer.Option(help="Folder of environment maps, latitude-longitude .exr and .hdr."),
    ] = None,
    environment_uploads: Annotated[
        bool,
        typer.Option("--allow-environment-uploads", help="Let requests add maps to that folder."),
    ] = False,
    engine: Annotated[
        str | None,
        typer.Option(help="What networks run on, as onnxruntime. Default: the first there is."),
    ] = None,
    precision: Annotated[
        str | None, typer.Option(help="How they calculate, as fp32. Default: as the CPU does best.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of a network run. Default: the CPUs we may use.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Pictures shaded at a time.")] = 3,
    queue: Annotated[int, typer.Option(min=0, help="Pictures that may wait; then 429.")] = 16,
    memory: Annotated[
        str | None,
        typer.Option(help="For pixels and networks, as 2G. Default: half of the machine's."),
    ] = None,
    max_body: Annotated[str | None, typer.Option(help="Largest body, as 500M.")] = None,
    max_uploads: Annotated[
        str | None,
        typer.Option(help="For bodies that arrive or wait, in sum. Default: twice --max-body."),
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option(
            help="For uploads that are kept to be shaded again, as 512M. Default: a quarter of"
            " --max-uploads."
        ),
    ] = None,
    max_files: Annotated[int, typer.Option(min=1, help="Most files of a form.")] = 32,
    max_decoded: Annotated[str | None, typer.Option(help="Largest decoded file.")] = None,
    max_pixels: Annotated[int | None, typer.Option(min=1, help="Most pixels of a part.")] = None,
    max_parts: Annotated[int | None, typer.Option(min=1, help="Most parts of a file.")] = None,
    max_channels: Annotated[
        int | None, typer.Option(min=1, help="Most channels of a file.")
    ] = None,
    body_timeout: Annotated[float, typer.Option(help="Seconds for a body to arrive.")] = 60.0,
    grace: Annotated[float, typer.Option(help="Seconds to finish work at the end.")] = 20.0,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(
            help="A name that the service is asked for by, beside addresses and this machine's own;"
            " '.example.com' is every name below it, '*' any; repeatable."
        ),
    ] = None,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(
            help="Whose pages may use the service in a browser, as https://example.com, beside its"
            " own; '*' any; repeatable."
        ),
    ] = None,
    live_sessions: Annotated[int, typer.Option(min=0, help="Most live sessions.")] = 8,
    live_viewers: Annotated[int, typer.Option(min=0, help="Most viewers of each.")] = 32,
    live_frame: Annotated[str, typer.Option(help="Largest live frame.")] = "64M",
    live_rate: Annotated[int, typer.Option(min=1, help="Most live frames a second.")] = 240,
    log_level: Annotated[
        LogLevel, typer.Option(case_sensitive=False, help="The least that is logged.")
    ] = "info",
) -> None:
    """Serve the shaders over HTTP.

    Examples:

      deepshade serve

      deepshade serve --port 9000 --models models --models shipped --environments maps
    """
    from dataclasses import replace

    from deepshade.bundles import bundle_roots, overlooked
    from deepshade.errors import ConfigError
    from deepshade.machine import cpu_count
    from deepshade.tokens import configured, is_loopback
    from deepshade_service.config import Settings, default_limits, default_memory
    from deepshade_service.memory import parse_size
    from deepshade_service.models import check_backend

    roots = bundle_roots(models or ())
    if note := overlooked(roots):
        typer.echo(note, err=True)
    if environments is not None and not environments.is_dir():
        raise ConfigError("environments", detail=f"there is no folder {environments}")
    if engine or precision:
        check_backend(engine, precision)  # said now, and not by every answer
    given = {
        "body_bytes": max_body and parse_size(max_body),
        "decoded_bytes": max_decoded and parse_size(max_decoded),
        "pixels": max_pixels,
        "parts": max_parts,
        "channels": max_channels,
    }
    uploads = parse_size(max_uploads) if max_uploads else 0
    settings = Settings(
        models=roots,
        environments=environments,
        environment_uploads=environment_uploads,
        engine=engine,
        precision=precision,
        limits=replace(default_limits(uploads), **{k: v for k, v in given.items() if v}),
        threads=threads or cpu_count(),
        memory=parse_size(memory) if memory else default_memory(),
        uploads=uploads,
        files=max_files,
        keep=parse_size(keep) if keep else 0,
        workers=workers,
        queue=queue,
        body_timeout=body_timeout,
        grace=grace,
        hosts=allow_host or (),
        origins=allow_origin or (),
        live_sessions=live_sessions,
        live_viewers=live_viewers,
        live_frame=parse_size(live_frame),
        live_rate=live_rate,
        token=configured(),
        beyond=not is_loopback(host),
    )
    if settings.beyond and settings.token is None and live_sessions:
        typer.echo(
            "live sessions are closed: others can reach this service, and it has no token; "
            "set DEEPSHADE_TOKEN to a long secret, or leave out --host",
            err=True,
        )
    with listen(host, port) as listener:
        _run(settings, listener, log_level)


def _run(settings: Settings, listener: socket.socket, log_level: str) -> None:
    import uvicorn

    from deepshade_service.app import create_app
    from deepshade_service.server import Server

    share_heaps()
    tracing.begin("deepshade-service")
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    print(f"deepshade is serving at http://{shown}:{port} (Ctrl-C stops it)", flush=True)
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        log_config=logging_config(log_level),
        # Without it uvicorn waits for open sockets for ever.
        timeout_graceful_shutdown=max(1, round(settings.grace)),
        server_header=False,
        ws_max_size=settings.live_frame,
        ws_per_message_deflate=False,  # frames are compressed by what knows them
        ws_ping_interval=4.0,  # who vanishes without a word shall leave no session
        ws_ping_timeout=8.0,
    )
    # uvicorn shuts down at SIGINT and SIGTERM and raises them again afterwards. By then all is
    # tidy, so they shall neither print a traceback nor turn a clean end into a failure.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    Server(config, app.state.service).run(sockets=[listener])
