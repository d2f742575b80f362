"""Runs docker-compose.yml's services as processes, without a container engine.

    sudo python scripts/topology.py            # up, until Ctrl-C; files below out/topology

Each service gets what the file says, from the same .env: command, environment, user without
capabilities, read-only root, volumes (folders here), tmpfs, and a network namespace in which the
others go by their names. As there, `back` leads nowhere, and of published ports the machine sees
one service's. Roots are those of `scripts/images.py` (--images), or else this machine's own with
the environment and the sources that run this script. Limits (cpus, mem_limit) are not set.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

import images  # noqa: E402

_VARIABLE = re.compile(r"\$\{(\w+)(?:(:-|:\?)([^}]*))?\}")
_PACKAGES = ("core", "service", "workers", "trainer", "clients", "reports")


def interpolated(value: Any, variables: Mapping[str, str]) -> Any:
    """Compose's ${NAME}, ${NAME:-default} and ${NAME:?message}. Raises KeyError for the last."""
    if isinstance(value, dict):
        return {key: interpolated(each, variables) for key, each in value.items()}
    if isinstance(value, list):
        return [interpolated(each, variables) for each in value]
    if not isinstance(value, str):
        return value

    def found(match: re.Match[str]) -> str:
        name, kind, text = match.groups()
        if given := variables.get(name):
            return given
        if kind == ":?":
            raise KeyError(f"{name}: {text}")
        return text or ""

    return _VARIABLE.sub(found, value)


def read(compose: Path, env: Path) -> dict[str, Any]:
    """A compose file with the variables of an .env file."""
    lines = (line.partition("=") for line in env.read_text().splitlines() if "=" in line)
    return dict(interpolated(yaml.safe_load(compose.read_text()), {k: v for k, _, v in lines}))


@dataclass
class Running:
    """One container's process: the one that waits for it, and the first within."""

    process: subprocess.Popen[bytes]
    first: int


class Topology:
    """The services of a compose file. Use it as a context, which ends all of them. Needs root."""

    def __init__(
        self, document: Mapping[str, Any], folder: Path, built: Path | None = None
    ) -> None:
        self.services: dict[str, Any] = document["services"]
        self._folder, self._built = folder.resolve(), built
        self.running: dict[str, Running] = {}
        self._made: list[str] = []
        self._bridge, self._net, self._addresses, self.published = "", 0, dict[str, str](), ""

    def _free(self) -> tuple[str, int]:
        """The bridge's namespace, and the N of 10.N.x.x: its name says that they are taken."""
        for net in range(64, 128):
            made = subprocess.run(["ip", "netns", "add", f"ds{net}"], capture_output=True)
            if made.returncode == 0:
                self._made.append(f"ds{net}")
                return f"ds{net}", net
        raise RuntimeError(f"no namespace ds64 to ds127 can be made: {made.stderr.decode()}")

    def _all(self) -> list[str]:
        return [*self.services, "ray-worker-2", "ray-worker-3"]

    def __enter__(self) -> Self:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._bridge, self._net = self._free()
        self._addresses = {name: f"10.{self._net}.0.{n + 10}" for n, name in enumerate(self._all())}
        self.published = f"10.{self._net}.1.2"
        hosts = "".join(f"{address} {name}\n" for name, address in self._addresses.items())
        (self._folder / "hosts").write_text("127.0.0.1 localhost\n" + hosts)
        self._ip("link set lo up", of=self._bridge)
        self._ip("link add br0 type bridge", "link set br0 up", of=self._bridge)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        for name in reversed(list(self.running)):
            self.stop(name)
        for space in reversed(self._made):
            subprocess.run(["ip", "netns", "delete", space], check=False)

    def up(self, *names: str, patience: float = 600.0) -> None:
        """Start services, in that order, each when those before it are healthy."""
        for name in names:
            self.start(name)
            self.wait(name, patience)

    def start(self, name: str) -> None:
        """Start one; `ray-worker-2` is another of `ray-worker`."""
        service, space = self._service(name), f"{self._bridge}-{len(self._made)}"
        if (netns := self._spaces().get(name)) is None:
            netns = self._attach(name, space, published=bool(service.get("ports")))
        script = self._folder / f"{name}.sh"
        script.write_text(self._script(name, service))
        command = ["ip", "netns", "exec", netns]
        command += ["unshare", "--mount", "--pid", "--ipc", "--uts", "--fork", "--kill-child"]
        with (self._folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [*command, "sh", str(script)], stdout=log, stderr=log, start_new_session=True
            )
        deadline = time.monotonic() + 10
        while not (children := self._children(process.pid)):
            if time.monotonic() > deadline or process.poll() is not None:
                raise RuntimeError(f"{name} doesn't start: {self.log(name)[-2000:]}")
            time.sleep(0.01)
        self.running[name] = Running(process, children[0])

    def wait(self, name: str, patience: float = 600.0) -> None:
        """Until its health check passes; one that ends begins again, as `restart` says.

        Raises RuntimeError where that helps in no time.
        """
        deadline = time.monotonic() + patience
        while True:
            if self.running[name].process.poll() is not None:
                self.start(name)
            found = self.execute(name, *self._health(name), check=False)
            if found.returncode == 0:
                return
            if time.monotonic() > deadline:
                raise RuntimeError(f"{name} isn't healthy: {found.stderr} {self.log(name)[-2000:]}")
            time.sleep(0.5)

    def execute(
        self, name: str, *command: str, check: bool = True, timeout: float = 600
    ) -> subprocess.CompletedProcess[str]:
        """As `docker compose exec`: a command in a running service, with its environment."""
        image = self._image(name)
        enter = [
            "nsenter",
            "-t",
            str(self.running[name].first),
            "-m",
            "-n",
            "-p",
            "-i",
            "-u",
            "-r",
            "-w",
        ]
        inside = [*enter, *self._inside(self._service(name), image, command)]
        try:
            done = subprocess.run(inside, capture_output=True, text=True, timeout=timeout)
        except subprocess.TimeoutExpired:  # its own words would show the tokens
            raise RuntimeError(f"{shlex.join(command)} in {name} takes too long") from None
        if check and done.returncode:
            raise RuntimeError(f"{shlex.join(command)} in {name}: {done.stdout}{done.stderr}")
        return done

    def kill(self, name: str) -> None:
        """SIGKILL to all of it."""
        running = self.running.pop(name)
        os.kill(running.first, signal.SIGKILL)  # a namespace ends with its first process
        running.process.wait()

    def stop(self, name: str, grace: float = 40.0) -> int:
        """SIGTERM, and SIGKILL after a while; the exit status."""
        running = self.running.pop(name)
        with suppress(ProcessLookupError):
            os.kill(running.first, signal.SIGTERM)
        try:
            return running.process.wait(grace)
        except subprocess.TimeoutExpired:
            running.process.kill()
            return running.process.wait()

    def log(self, name: str) -> str:
        """What it has printed."""
        return (self._folder / f"{name}.log").read_text(errors="replace")

    def volume(self, name: str) -> Path:
        """The folder of a volume."""
        return self._folder / "volumes" / name

    def _service(self, name: str) -> Any:
        return self.services[re.sub(r"-\d+$", "", name)]

    def _image(self, name: str) -> images.Image:
        (stages,) = (self._service(name)["build"]["dockerfile"],)
        (*_, last) = images.read(ROOT / stages, {})
        image = images.Image()
        for kind, value in last.instructions:
            if kind == "ENV":
                pairs = (pair.partition("=") for pair in shlex.split(value))
                image.env |= {key: text for key, _, text in pairs}
            elif kind == "WORKDIR":
                image.workdir = value
            elif kind == "HEALTHCHECK":
                image.health = images.words(value.partition("CMD ")[2])
            elif kind == "CMD":
                image.command = images.words(value)
        return image

    def _health(self, name: str) -> list[str]:
        return self._image(name).health

    def _root(self, name: str) -> Path:
        if self._built is None:
            return Path("/")
        dockerfile = Path(self._service(name)["build"]["dockerfile"])
        return (self._built / dockerfile.stem / "root").resolve()

    def _inside(self, service: Any, image: images.Image, command: Sequence[str]) -> list[str]:
        """A command as the service's user, with the image's and the service's environment."""
        env = image.env | {k: str(v) for k, v in service.get("environment", {}).items()}
        if self._built is None:
            env["PATH"] = f"{self._folder / 'bin'}:{Path(sys.executable).parent}:/usr/bin:/bin"
            env["PYTHONPATH"] = ":".join(str(ROOT / each) for each in _PACKAGES)
            env["OMP_NUM_THREADS"] = "1"
        user, group = str(service["user"]).split(":")
        drop = ["setpriv", f"--reuid={user}", f"--regid={group}", "--clear-groups"]
        drop += ["--bounding-set=-all", "--inh-caps=-all", "--no-new-privs"]
        setting = [f"{key}={value}" for key, value in env.items()]
        shell = f"cd {shlex.quote(image.workdir)} && exec {shlex.join(command)}"
        return [*drop, "/usr/bin/env", "-i", *setting, "sh", "-c", shell]

    def _script(self, name: str, service: Any) -> str:
        image, scratch = self._image(name), self._folder / "roots" / name
        scratch.mkdir(parents=True, exist_ok=True)
        at = scratch / "root"
        quoted = shlex.quote
        lines = ["set -e", "mount --make-rprivate /", f"mount -t tmpfs none {quoted(str(scratch))}"]
        lines.append(f"cd {quoted(str(scratch))} && mkdir upper work root")
        lower = f"lowerdir={self._root(name)},upperdir=upper,workdir=work"
        lines.append(f"mount -t overlay -o {lower} overlay root")
        if self._built is None:
            self._shims()
            passed = {ROOT, Path(sys.prefix), Path(sys.base_prefix), self._folder}
            self._seen(name, service, passed - {self._folder})
            parents = {p for each in passed for p in (each, *each.parents)} - {Path("/")}
            lines.append(f"chmod o+x {' '.join(quoted(f'root{p}') for p in sorted(parents))}")
        lines += ["mount -t proc proc root/proc", "mount -t sysfs -o ro sysfs root/sys"]
        lines.append("mount --rbind /dev root/dev")
        shared = service.get("shm_size", "64m")
        lines.append(f"mount -t tmpfs -o size={shared},mode=1777 none root/dev/shm")
        for volume in sorted(service.get("volumes", ()), key=lambda v: v.split(":")[1]):
            source, target, *mode = volume.split(":")
            here = self.volume(source)
            here.mkdir(parents=True, exist_ok=True)
            user, group = map(int, service["user"].split(":"))
            os.chown(here, user, group)
            place = quoted(f"root{target}")
            lines.append(f"mkdir -p {place} && mount --bind {quoted(str(here))} {place}")
            if mode:
                lines.append(f"mount -o remount,bind,{mode[0]} {place}")
        for each in service.get("tmpfs", ()):
            target, _, options = each.partition(":")
            lines.append(f"mount -t tmpfs -o {options} none root{target}")
        lines.append(f"mkdir -p root{image.workdir}")
        lines.append("touch root/etc/hosts")
        lines.append(f"mount --bind {quoted(str(self._folder / 'hosts'))} root/etc/hosts")
        if service.get("read_only"):
            lines.append("mount -o remount,bind,ro root")
        command = service.get("command", image.command)
        command = shlex.split(command) if isinstance(command, str) else command
        lines.append(f"hostname {name}")
        inside = self._inside(service, image, command)
        lines.append(f"exec chroot {quoted(str(at))} {shlex.join(inside)}")
        return "\n".join(lines) + "\n"

    def _seen(self, name: str, service: Any, passed: set[Path]) -> None:
        """Raises RuntimeError where a container's tmpfs would hide what it runs from."""
        for target in (each.partition(":")[0] for each in service.get("tmpfs", ())):
            if hidden := [str(each) for each in passed if each.is_relative_to(target)]:
                raise RuntimeError(
                    f"{', '.join(sorted(hidden))} can't be seen in {name}, which has a tmpfs at "
                    f"{target}: run this from a clone and an environment elsewhere"
                )

    def _shims(self) -> None:
        """Commands that this environment's own may lack: those of the sources."""
        folder = self._folder / "bin"
        folder.mkdir(exist_ok=True)
        for name, module in (
            ("deepshade", "deepshade.cli"),
            ("deepshade-trainer", "deepshade_trainer.service.cli"),
            ("deepshade-client", "deepshade_client.cli"),
        ):
            text = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m {module} "$@"\n'
            if not (folder / name).exists():
                (folder / name).write_text(text)
                (folder / name).chmod(0o755)

    def _children(self, pid: int) -> list[int]:
        with suppress(OSError):
            text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
            return [int(word) for word in text.split()]
        return []

    def _spaces(self) -> dict[str, str]:
        return getattr(self, "_attached", {})

    def _attach(self, name: str, space: str, *, published: bool) -> str:
        """A network namespace on the bridge, and for who has a published port to the machine."""
        self._namespace(space)
        address, inner = self._addresses[name], f"v{len(self._made)}"
        self._ip(
            f"link add eth0 type veth peer name {inner} netns {self._bridge}",
            f"addr add {address}/24 dev eth0",
            "link set eth0 up",
            of=space,
        )
        self._ip(f"link set {inner} master br0 up", of=self._bridge)
        if published:
            outer = f"{self._bridge}p"
            subprocess.run(
                shlex.split(f"ip link add {outer} type veth peer name eth1 netns {space}"),
                check=True,
            )
            for line in (
                f"ip addr add 10.{self._net}.1.1/30 dev {outer}",
                f"ip link set {outer} up",
            ):
                subprocess.run(shlex.split(line), check=True)
            self._ip(f"addr add {self.published}/30 dev eth1", "link set eth1 up", of=space)
        self._attached = {**self._spaces(), name: space}
        return space

    def _namespace(self, name: str) -> None:
        subprocess.run(["ip", "netns", "add", name], check=True)
        self._made.append(name)
        self._ip("link set lo up", of=name)

    def _ip(self, *lines: str, of: str) -> None:
        for line in lines:
            subprocess.run(["ip", "-n", of, *line.split()], check=True)


def permitted() -> bool:
    """Whether this machine lets us make namespaces and mounts."""
    tools = all(shutil.which(each) for each in ("ip", "unshare", "nsenter", "setpriv"))
    test = [
        "unshare",
        "--mount",
        "--net",
        "--pid",
        "--fork",
        "mount",
        "-t",
        "tmpfs",
        "none",
        "/mnt",
    ]
    return tools and os.geteuid() == 0 and not subprocess.run(test, capture_output=True).returncode


def main() -> int:
    """Bring all up and wait for Ctrl-C."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", type=Path, default=ROOT / ".env", help="of deploy/env.py")
    parser.add_argument("--out", type=Path, default=ROOT / "out/topology")
    parser.add_argument("--images", type=Path, help="of scripts/images.py: OUT/service and so on")
    asked = parser.parse_args()
    if not permitted():
        print("this needs root, and leave to make namespaces and mounts", file=sys.stderr)
        return 2
    document = read(ROOT / "docker-compose.yml", asked.env)
    with Topology(document, asked.out, asked.images) as topology:
        topology.up("service", "ray-head", "ray-worker", "trainer")
        print(f"the service answers at http://{topology.published}:8000 (Ctrl-C stops all)")
        with suppress(KeyboardInterrupt):
            signal.pause()
    return 0


if __name__ == "__main__":
    sys.exit(main())
