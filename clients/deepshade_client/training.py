"""`deepshade-client train`, `jobs`, `bundles`, `pin` and `rollback`: what a trainer offers."""

from __future__ import annotations

import hashlib
import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from deepshade_client.trainer import Trainer

Server = Annotated[
    str,
    typer.Option("--server", envvar="DEEPSHADE_TRAINER", help="Address of the trainer service."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Machine-readable output on stdout.")]
Name = Annotated[str, typer.Argument(metavar="EFFECT/NAME", help="A bundle, as ao/balanced.")]
TRAINER = "http://127.0.0.1:8001"


def train(
    effect: Annotated[str, typer.Argument(help="Effect to fine-tune, such as 'ao'.")],
    data: Annotated[
        str | None, typer.Option(help="Data folder that the trainer can see, below its --data.")
    ] = None,
    upload: Annotated[
        Path | None, typer.Option(help="Data folder here, to send first.", exists=True)
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option(help="Scene that the trainer can see, or procedural:FAMILY:SEED, to render."),
    ] = None,
    views: Annotated[int, typer.Option(min=8, help="Views of the scene.")] = 64,
    size: Annotated[int, typer.Option(min=16, help="Their side, pixels.")] = 256,
    spp: Annotated[int, typer.Option(min=2, help="Their reference rays a pixel.")] = 256,
    base: Annotated[str, typer.Option(help="Bundle to begin with.")] = "balanced",
    name: Annotated[
        str | None, typer.Option(help="What to publish it as. Default: as the base.")
    ] = None,
    minutes: Annotated[float, typer.Option(min=0.01, help="Of training.")] = 10.0,
    steps: Annotated[int, typer.Option(min=0, help="Steps, instead of minutes.")] = 0,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    lr: Annotated[float, typer.Option(min=0, help="Learning rate; 0 is the trainer's own.")] = 0.0,
    share: Annotated[
        float, typer.Option(help="Of what it learns, from the trainer's older views.")
    ] = 0.5,
    worse: Annotated[
        float, typer.Option(help="Share by which it may get worse on the trainer's test.")
    ] = 0.03,
    slower: Annotated[float, typer.Option(help="Times the base's time that it may take.")] = 1.1,
    processes: Annotated[int, typer.Option(min=1, help="Above 1: on Ray, together.")] = 1,
    preview: Annotated[
        Path | None, typer.Option(help="PNG to save the job's picture to, as it goes.")
    ] = None,
    detach: Annotated[bool, typer.Option("--detach", help="Ask, and don't wait.")] = False,
    server: Server = TRAINER,
    as_json: AsJson = False,
) -> None:
    """Fine-tune a shader to views of one's own; it is published if it is better.

    Ctrl-C stops watching, not the job: the same command watches again. Exit codes: 0 published,
    4 not better, 1 failed or cancelled, 3 the trainer can't be reached.

    Examples:

      deepshade-client train ao --upload data/shot --preview shot.png

      deepshade-client train ao --scene shot/set.glb --views 64 --minutes 10
    """
    from deepshade.errors import ConfigError
    from deepshade_client.trainer import Trainer

    if sum(each is not None for each in (data, upload, scene)) != 1:
        raise ConfigError("data", detail="what to tune to? give one of --data, --upload, --scene")
    asked: dict[str, Any] = {
        "base": base,
        "name": name,
        "data": data,
        "minutes": minutes,
        "steps": steps,
        "seed": seed,
        "lr": lr,
        "share": share,
        "worse": worse,
        "slower": slower,
        "processes": processes,
    }
    if scene is not None:
        asked |= {"scene": scene, "views": views, "size": size, "spp": spp}
    with Trainer(server) as trainer:
        if upload is not None:
            asked["upload"] = _sent(trainer, upload, hidden=as_json)
        job = trainer.train(effect, **asked)
        if not detach:
            job = _watched(trainer, job, preview, hidden=as_json)
    if as_json:
        print(json.dumps(job, indent=2))
    elif detach:
        print(f"job {job['id']} is {job['state']}; the same command watches it")
    if not detach and job["published"] is None:
        raise typer.Exit(4 if job["state"] == "done" else 1)


def jobs(
    cancel: Annotated[str | None, typer.Option(help="Stop this job first.")] = None,
    watch: Annotated[str | None, typer.Option(help="Follow this one until it ends.")] = None,
    preview: Annotated[
        Path | None, typer.Option(help="With --watch: PNG to save its picture to.")
    ] = None,
    server: Server = TRAINER,
    as_json: AsJson = False,
) -> None:
    """List the trainer's jobs, the last first; cancel one, or watch it.

    Example: deepshade-client jobs --watch 3f2a9c0d1e4b5a67
    """
    from deepshade_client.trainer import Trainer

    with Trainer(server) as trainer:
        if cancel is not None:
            trainer.cancel(cancel)
        if watch is not None:
            job = _watched(trainer, trainer.job(watch), preview, hidden=as_json)
            found = [job]
        else:
            found = trainer.jobs()
    if as_json:
        print(json.dumps(found, indent=2))
    elif watch is None:
        _print_jobs(found)


def bundles(server: Server = TRAINER, as_json: AsJson = False) -> None:
    """List what was published: which version answers, which there are, which is pinned.

    Shading services answer this too: --server http://127.0.0.1:8000.

    Example: deepshade-client bundles
    """
    from deepshade_client.trainer import Trainer

    with Trainer(server) as trainer:
        found = trainer.bundles()
    if as_json:
        print(json.dumps(found, indent=2))
    else:
        _print_bundles(found)


def pin(
    bundle: Name,
    version: Annotated[int | None, typer.Argument(help="Its version.")] = None,
    off: Annotated[bool, typer.Option("--off", help="Follow what is published again.")] = False,
    server: Server = TRAINER,
    as_json: AsJson = False,
) -> None:
    """Answer with one version, whatever is published; or with --off follow again.

    Examples:

      deepshade-client pin ao/balanced 2

      deepshade-client pin ao/balanced --off
    """
    from deepshade.errors import ConfigError
    from deepshade_client.trainer import Trainer

    effect, name = _split(bundle)
    if off == (version is not None):
        raise ConfigError("version", detail="give the version to pin, or --off")
    with Trainer(server) as trainer:
        if version is None:
            found = trainer.unpin(effect, name)
        else:
            found = trainer.pin(effect, name, version)
    _said(found, as_json)


def rollback(bundle: Name, server: Server = TRAINER, as_json: AsJson = False) -> None:
    """Answer with the version before the current one.

    Example: deepshade-client rollback ao/balanced
    """
    from deepshade_client.trainer import Trainer

    with Trainer(server) as trainer:
        _said(trainer.roll_back(*_split(bundle)), as_json)


def _split(bundle: str) -> tuple[str, str]:
    from deepshade.errors import ConfigError

    effect, _, name = bundle.partition("/")
    if not name:
        raise ConfigError("bundle", detail=f"{bundle!r} must be like ao/balanced")
    return effect, name


def _sent(trainer: Trainer, folder: Path, *, hidden: bool) -> str:
    """The name under which the trainer has the folder: by its manifest, so that it's sent once."""
    from deepshade.console import Watch
    from deepshade.manifest import NAME, Manifest

    Manifest.read(folder)
    name = f"sent-{hashlib.sha256((folder / NAME).read_bytes()).hexdigest()[:16]}"
    with Watch("sending", "files", hidden=hidden) as watch:
        trainer.upload(name, folder, watch.update)
    return name


def _watched(
    trainer: Trainer, job: dict[str, Any], preview: Path | None, *, hidden: bool
) -> dict[str, Any]:
    """The job when it ends; meanwhile a bar for each of its phases."""
    from contextlib import ExitStack

    from deepshade.console import Watch

    if not hidden:
        print(f"job {job['id']}: {job['state']}", flush=True)
    phase, watch = "", None
    with ExitStack() as stack:
        for event in trainer.events(job["id"]):
            found = event.data
            if event.kind in ("job", "end"):
                job = found
                if not hidden and event.kind == "job" and job["state"] == "queued":
                    print(f"{job['before']} wait before it", flush=True)
                continue
            if found["phase"] != phase:
                phase = found["phase"]
                stack.close()
                watch = stack.enter_context(Watch(phase, "steps", hidden=hidden))
                if "step" not in found:
                    watch.say(f"{phase} …")
            if watch is not None and "step" in found:
                watch.update(found["step"], found["steps"], _note(found))
            if found.get("warning") and watch is not None:
                watch.say(found["warning"], "yellow")
            if found.get("validation") and watch is not None:
                figures = found["validation"]
                watch.say(f"step {found['step']}: DSSIM {figures['dssim']:.4f} on views that judge")
            if found.get("preview") and preview is not None:
                trainer.preview(job["id"], preview)
    if not hidden:
        print(job["sentence"])
        if job["fix"]:
            print(f"  fix: {job['fix']}")
        if preview is not None and preview.exists():
            print(f"its picture: {preview}")
    return job


def _note(event: dict[str, Any]) -> str:
    parts = []
    if event.get("loss") is not None:
        parts.append(f"loss {event['loss']:.4f}")
    if event.get("rate"):
        parts.append(f"{event['rate']:.2g} steps/s")
    return "  ".join(parts)


def _print_jobs(found: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from deepshade.console import stdout

    table = Table("job", "asked", "bundle", "state", "what came of it")
    for job in found:
        asked = datetime.fromtimestamp(job["created"]).strftime("%m-%d %H:%M")
        table.add_row(
            job["id"],
            asked,
            escape(f"{job['effect']}/{job['name']}"),
            _state(job),
            escape(job["sentence"]),
        )
    stdout().print(table)


def _state(job: dict[str, Any]) -> str:
    progress = job.get("progress") or {}
    if job["state"] == "queued":
        return f"queued, {job['before']} before"
    if job["state"] == "running" and "step" in progress:
        return f"{progress['phase']} {progress['step']}/{progress['steps']}"
    return str(progress.get("phase", "running") if job["state"] == "running" else job["state"])


def _print_bundles(found: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from deepshade.console import stdout

    table = Table("bundle", "answers", "versions", "pinned", "sha256")
    for each in found:
        number, pinned = each["number"], each["pinned"]
        table.add_row(
            escape(f"{each['effect']}/{each['name']}"),
            "" if number is None else str(number),
            " ".join(map(str, each["versions"])),
            "" if pinned is None else str(pinned),
            str(each["sha256"] or "")[:16],
        )
    stdout().print(table)


def _said(found: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(found, indent=2))
        return
    pinned = ", pinned" if found["pinned"] is not None else ""
    print(f"{found['effect']}/{found['name']} answers with version {found['number']}{pinned}")
    if found.get("said"):
        print(found["said"])
