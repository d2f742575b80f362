"""docker-compose.yml: by Compose's own schema, by a linter, and by what we promise of it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

OURS = ("service", "trainer", "ray-head", "ray-worker")


@pytest.fixture(scope="module")
def document(
    root: Path, topology: ModuleType, secrets: ModuleType, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    env = tmp_path_factory.mktemp("env") / ".env"
    assert secrets.main(["--out", str(env), "--postgres"]) == 0
    read: dict[str, Any] = topology.read(root / "docker-compose.yml", env)
    return read


def schema(*files: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"]
    return subprocess.run([*command, *map(str, files)], capture_output=True, text=True)


def test_the_files_are_of_compose_s_schema(root: Path, tmp_path: Path) -> None:
    """compose-spec's, as the package check-jsonschema carries it; no network is asked."""
    files = [root / "docker-compose.yml", root / "deploy/gpu.yml"]
    assert schema(*files).returncode == 0, schema(*files).stdout
    (wrong := tmp_path / "wrong.yml").write_text("services: {a: {image: b, read_onyl: true}}")
    assert "read_onyl" in schema(wrong).stdout


def test_a_linter_finds_nothing_grave(root: Path) -> None:
    """compose-lint, with OWASP's rules for containers. Digests are whoever deploys': deploy.md."""
    command = [sys.executable, "-m", "compose_lint", "--format", "json"]
    done = subprocess.run(
        [*command, str(root / "docker-compose.yml")], capture_output=True, text=True
    )
    found = json.loads(done.stdout)["findings"]
    grave = [f for f in found if f["severity"] in ("high", "critical")]
    assert not grave, json.dumps(grave, indent=1)


def test_only_the_service_s_port_leaves_the_machine(document: dict[str, Any]) -> None:
    services = document["services"]
    ports = {name: each["ports"] for name, each in services.items() if "ports" in each}
    assert ports == {"service": ["127.0.0.1:8000:8000"], "grafana": ["127.0.0.1:3000:3000"]}
    assert services["grafana"]["profiles"] == ["monitoring"]
    assert document["networks"]["back"]["internal"]
    inner = {name for name, each in services.items() if each["networks"] == ["back"]}
    assert inner == set(services) - {"service", "grafana"}
    for each in services.values():
        assert "network_mode" not in each and "privileged" not in each


def test_each_service_is_held_in_bounds(document: dict[str, Any], images: ModuleType) -> None:
    for name, each in document["services"].items():
        assert each["read_only"] and each["cap_drop"] == ["ALL"], name
        assert each["security_opt"] == ["no-new-privileges:true"], name
        assert not each["user"].startswith(("0", "root")), name
        assert each["cpus"] and each["mem_limit"] and each["pids_limit"], name
        assert each["logging"]["options"]["max-size"], name
        assert "healthcheck" in each or name in OURS, name
        sources = [volume.split(":")[0] for volume in each.get("volumes", ())]
        assert {s for s in sources if not s.startswith("./deploy/")} <= set(document["volumes"])


def test_the_shading_service_cannot_change_what_it_serves(document: dict[str, Any]) -> None:
    services = document["services"]
    assert "models:/models:ro" in services["service"]["volumes"]
    assert "models:/models" in services["trainer"]["volumes"]
    assert "RAY_AUTH_TOKEN" not in services["service"]["environment"]


def test_paths_that_ray_writes_are_the_trainer_s(document: dict[str, Any]) -> None:
    """What a job has rendered must be under one path on all of them."""
    services = document["services"]
    for name in ("trainer", "ray-head", "ray-worker"):
        assert "rendered:/jobs/rendered" in services[name]["volumes"], name
        for kept in ("shards:/shards", "library:/library"):
            assert any(v.startswith(kept) for v in services[name]["volumes"]), name


def test_without_tokens_nothing_starts(root: Path, topology: ModuleType, tmp_path: Path) -> None:
    (env := tmp_path / ".env").write_text("RAY_AUTH_TOKEN=x\n")
    with pytest.raises(KeyError, match=r"DEEPSHADE_TOKEN: run deploy/env\.py"):
        topology.read(root / "docker-compose.yml", env)


def test_gpu_file_only_adds_to_services_that_there_are(root: Path) -> None:
    whole = yaml.safe_load((root / "docker-compose.yml").read_text())["services"]
    added = yaml.safe_load((root / "deploy/gpu.yml").read_text())["services"]
    assert set(added) <= set(whole)
    for name, each in added.items():
        for argument in each.get("build", {}).get("args", {}):
            dockerfile = root / whole[name]["build"]["dockerfile"]
            assert f"ARG {argument}=" in dockerfile.read_text(), (name, argument)


def test_secrets_are_new_long_and_their_owner_s(secrets: ModuleType, tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    assert secrets.main(["--out", str(first)]) == 0
    assert secrets.main(["--out", str(second)]) == 0
    assert first.stat().st_mode & 0o777 == 0o600
    lines = [dict(x.split("=", 1) for x in f.read_text().split()) for f in (first, second)]
    for key in ("DEEPSHADE_TOKEN", "RAY_AUTH_TOKEN", "POSTGRES_PASSWORD"):
        assert len(bytes.fromhex(lines[0][key])) == 32
        assert lines[0][key] != lines[1][key]
    assert len({lines[0][k] for k in lines[0] if lines[0][k]}) == 4  # none is used twice


def test_secrets_in_use_are_not_overwritten(
    secrets: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / ".env"
    assert secrets.main(["--out", str(path), "--postgres"]) == 0
    before = path.read_text()
    assert "DEEPSHADE_DATABASE=postgresql+psycopg://deepshade:" in before
    assert secrets.main(["--out", str(path)]) == 2
    assert path.read_text() == before
    assert "move it away" in capsys.readouterr().err
    assert secrets.main(["--out", str(tmp_path / "no" / "where")]) == 2
