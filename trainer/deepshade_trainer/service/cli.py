"""`deepshade-trainer serve`, which is `deepshade trainer` too."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from deepshade import tracing
from deepshade.cli import CONTEXT, Version, run
from deepshade.serving import listen, logging_config

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, context_settings=CONTEXT)

LogLevel = Literal["critical", "error", "warning", "info", "debug"]


@app.callback()
def root(show_version: Version = False) -> None:
    """Fine-tune shaders as a service.

    Example: deepshade-trainer serve --data /projects/shots
    """


@app.command()
def serve(
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8001,
    folder: Annotated[
        Path, typer.Option(help="For jobs, uploads and rendered views; one service a folder.")
    ] = Path("trainer"),
    published: Annotated[
        Path | None,
        typer.Option(help="Folder of models that versions go to. Default: FOLDER/models."),
    ] = None,
    models: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of bundles to begin with, or 'shipped'; repeatable. Default: as"
            " 'deepshade serve'."
        ),
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Folder that data and scenes may lie in; repeatable. Default: none."),
    ] = None,
    library: Annotated[
        Path | None,
        typer.Option(help="Older views: EFFECT/rehearsal to train on, EFFECT/test to judge by."),
    ] = None,
    database: Annotated[
        str,
        typer.Option(
            envvar="DEEPSHADE_DATABASE",
            help="As postgresql+psycopg://user:password@host/name. Default: SQLite in FOLDER.",
        ),
    ] = "",
    service: Annotated[
        list[str] | None,
        typer.Option(help="Shading service to tell of changes, http://host:8000; repeatable."),
    ] = None,
    at_a_time: Annotated[int, typer.Option(min=1, help="Jobs that run at a time.")] = 1,
    threads: Annotated[int, typer.Option(min=0, help="Of a job; 0: the CPUs we may use.")] = 0,
    queue: Annotated[int, typer.Option(min=1, help="Jobs that may wait; then 429.")] = 100,
    max_uploads: Annotated[
        float, typer.Option(min=0.001, help="GiB that all uploads together may take.")
    ] = 20.0,
    ray_address: Annotated[
        str, typer.Option(help="A running Ray cluster to render on. Default: one of its own.")
    ] = "",
    log_level: Annotated[
        LogLevel, typer.Option(case_sensitive=False, help="The least that is logged.")
    ] = "info",
) -> None:
    """Fine-tune shaders to one's own scenes over HTTP, and publish what is better.

    $DEEPSHADE_TOKEN is the token that requests must bring, and that shading services are told
    with; without one only this machine may ask.

    Examples:

      deepshade-trainer serve --data /projects/shots --service http://127.0.0.1:8000

      deepshade trainer --data /projects/shots   # the same program

      deepshade serve --models trainer/models --models shipped   # what serves the results
    """
    from deepshade.bundles import bundle_roots
    from deepshade.errors import ConfigError
    from deepshade.machine import cpu_count
    from deepshade.tokens import VARIABLE, configured, is_loopback
    from deepshade_trainer.service.config import Settings

    token = configured()
    if token is None and not is_loopback(host):
        raise ConfigError(
            "host",
            detail=f"--host {host} is beyond this machine: set ${VARIABLE} first, such as "
            f"export {VARIABLE}=$(openssl rand -hex 32)",
        )
    settings = Settings(
        folder=folder,
        published=published or folder / "models",
        bases=bundle_roots(models or ()),
        data=tuple(data or ()),
        library=library,
        database=database,
        services=tuple(service or ()),
        token=token,
        at_a_time=at_a_time,
        threads=threads or cpu_count(),
        queue=queue,
        upload_bytes=int(max_uploads * 2**30),
        ray_address=ray_address,
    )
    with listen(host, port) as listener:
        import uvicorn

        from deepshade_trainer.service.app import create_app

        where, number = listener.getsockname()[:2]
        shown = f"[{where}]" if ":" in where else where
        tracing.begin("deepshade-trainer")
        application = create_app(settings)
        print(f"deepshade trains at http://{shown}:{number} (Ctrl-C stops it)", flush=True)
        config = uvicorn.Config(
            application,
            log_config=logging_config(log_level),
            timeout_graceful_shutdown=2,  # streams of events don't end by themselves
            server_header=False,
        )
        # uvicorn raises the signal again when all is tidy: that shall be a clean end.
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, lambda *_: None)
        uvicorn.Server(config).run(sockets=[listener])
        tracing.end()


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run(typer.main.get_command(app), arguments, name="deepshade-trainer")


if __name__ == "__main__":
    sys.exit(main())
