"""The process of one job: `python -m deepshade_trainer.tuning.worker FOLDER`.

It ends with whoever began it, whose end of standard input then closes, and never runs twice for
one folder. Exit codes are those of commands: 0 done, 2 it can't be done, 130 asked to stop.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deepshade.errors import DataError, DeepshadeError
from deepshade_trainer.tuning.events import EventLog
from deepshade_trainer.tuning.plan import Plan
from deepshade_trainer.tuning.rendering import Rendering

POLL = 0.5  # seconds

_rendering: subprocess.Popen[bytes] | None = None


def main(folder: Path) -> int:
    """Do the job of a folder, or go on with it; its events say how it goes."""
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a worker of a service that was killed ends in a moment
        log = EventLog(folder)
        try:
            plan = Plan.read(folder)
            for event in _all(plan, folder):
                log.add(event)
        except DeepshadeError as error:
            log.add({"phase": "failed", "error": str(error), "fix": error.fix})
            return error.exit_code
        except KeyboardInterrupt:
            return 130
        except Exception as error:
            log.add({"phase": "failed", "error": f"{type(error).__name__}: {error}", "fix": ""})
            raise
    return 0


def _all(plan: Plan, folder: Path) -> Iterator[dict[str, Any]]:
    import torch

    from deepshade_trainer.tuning.finetune import finetune

    rendering = Rendering.read(folder)
    if rendering is not None:
        yield from _rendered(rendering)
    torch.set_num_threads(plan.threads)
    event: dict[str, Any] = {}
    for event in finetune(plan, folder):
        yield event
    if event.get("phase") != "judged":  # the steps stopped early, having saved
        raise KeyboardInterrupt


def _rendered(rendering: Rendering) -> Iterator[dict[str, Any]]:
    """Render what is missing, by datagen in a process of its own."""
    global _rendering
    if rendering.count == rendering.views:
        return
    process = subprocess.Popen(
        rendering.command(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    _rendering = process
    said: list[bytes] = []
    assert process.stderr is not None
    reader = threading.Thread(target=lambda: said.extend(process.stderr or ()), daemon=True)
    reader.start()
    try:
        done = -1
        while process.poll() is None:
            if (count := rendering.count) != done:
                done = count
                yield {"phase": "rendering", "step": done, "steps": rendering.views}
            time.sleep(POLL)
    finally:
        stop_rendering()
    reader.join(5)
    if process.returncode:
        text = b"".join(said[-8:]).decode(errors="replace").strip()
        raise DataError(f"the views can't be rendered: {text[-1000:]}")


def stop_rendering() -> None:
    """End datagen, and what Ray began for it."""
    if _rendering is None or _rendering.poll() is not None:
        return
    os.killpg(_rendering.pid, signal.SIGINT)
    try:
        _rendering.wait(10)
    except subprocess.TimeoutExpired:
        os.killpg(_rendering.pid, signal.SIGKILL)


def _end_with_parent() -> None:
    """When nobody holds the other end of standard input any more, end at once."""

    def wait() -> None:
        # not by sys.stdin, whose lock a process that is forked meanwhile would wait for
        while os.read(0, 1):
            pass
        if _rendering is not None and _rendering.poll() is None:
            os.killpg(_rendering.pid, signal.SIGKILL)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _interrupted(*_: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _interrupted)
    _end_with_parent()
    sys.exit(main(Path(sys.argv[1])))
