"""Runs the shell blocks of the documents, line by line, as a reader would who pastes them.

What the walks (`artist.py`, `engine.py`, `researcher.py`) share. Each line is shown, and the time
it took. Needs bash; `deepshade` is that of the Python which runs this.
"""

from __future__ import annotations

import os
import re
import shlex
import socket
import subprocess
import sys
from pathlib import Path
from typing import IO

DOCS = Path(__file__).resolve().parent.parent
ADDRESS = "127.0.0.1:8000"  # of the service, in the documents
HEAD = """set -euo pipefail
show() { printf '$ %s\\n' "$1"; begun=$SECONDS; }
took() { printf '# %s s\\n\\n' $((SECONDS - begun)); }
"""


def block(document: str, heading: str, language: str = "sh", number: int = 0) -> str:
    """A block of code below a heading of a document, by its name below the repository.

    `number` counts the heading's blocks in that language from 0. Raises ValueError without one.
    """
    text = (DOCS / document).read_text("utf-8")
    below = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#+ |\Z)", outside(text), re.M | re.S)
    start, end = below.span(1) if below else (0, 0)
    found = re.findall(rf"^```{language}\n(.*?)^```", text[start:end], re.MULTILINE | re.DOTALL)
    if len(found) <= number:
        raise ValueError(f"{document} has no {language} block {number} under {heading!r}")
    return str(found[number])


def outside(text: str) -> str:
    """The text with code blocks blanked out, whose comments look like headings."""
    return re.sub(r"^```.*?^```", lambda m: re.sub(r"[^\n]", " ", m[0]), text, flags=re.M | re.S)


def lines(shell: str) -> list[str]:
    """A shell block's commands, continued lines joined, without comments of their own."""
    joined = (line.strip() for line in shell.replace("\\\n", " ").splitlines())
    return [line for line in joined if line and not line.startswith("#")]


def run(*blocks: str, folder: Path | None = None, log: IO[str] | None = None) -> int:
    """Run shell blocks in `folder`, in one shell; the exit code is that of the first that fails.

    A service that they start goes on to the end, at a free port in place of 8000. `log` gets what
    they print, in place of this program's own output.
    """
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    script = HEAD
    for line in (line for shell in blocks for line in lines(shell)):
        words = shlex.split(line, comments=True)
        script += f"show {shlex.quote(line)}\n"
        if words[:2] == ["deepshade", "serve"]:
            command = shlex.join([word for word in words if word != "&"])
            script += f"{command} --port {port} --log-level warning & service=$!\n"
            script += "trap 'kill $service; wait $service || :' EXIT\n"
            script += f"until : 2>/dev/null </dev/tcp/127.0.0.1/{port}; do\n"  # it is serving
            script += "kill -0 $service; sleep 0.2; done\n"
        else:
            script += f"{line.replace(ADDRESS, f'127.0.0.1:{port}')}\n"
        script += "took\n"
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    env = {**os.environ, "PATH": path, "DEEPSHADE_SERVER": f"http://127.0.0.1:{port}"}
    sys.stdout.flush()
    command = ["bash", "-c", script]
    return subprocess.run(command, cwd=folder, env=env, stdout=log, stderr=log).returncode
