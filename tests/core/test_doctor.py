"""`deepshade doctor`, libLLVM's search, and what the machine allows."""

import json
import platform
import re
import socket

import pytest

from deepshade import doctor, extras, machine
from deepshade.cli import main
from deepshade.llvm import find_libllvm, libllvm_version


def library(folder, name):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(b"")
    return folder / name


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-19.so", 19),
        ("libLLVM.so.19.1", 19),
        ("libLLVM-17.so.1", 17),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM.dylib", None),
        ("libc.so.6", None),
    ],
)
def test_libllvm_versions(tmp_path, name, version):
    assert libllvm_version(library(tmp_path / "lib", name)) == version


def test_finds_the_best_libllvm(tmp_path):
    folders = (str(tmp_path / "a"), str(tmp_path / "llvm-*/lib"))
    assert find_libllvm({}, folders) is None
    library(tmp_path / "a", "libLLVM-14.so.1")
    library(tmp_path / "a", "libLLVM-16.so.1")
    assert find_libllvm({}, folders) is None  # refused, and crashing
    newer = library(tmp_path / "llvm-21/lib", "libLLVM.so.21.1")
    assert find_libllvm({}, folders) == newer
    known = library(tmp_path / "a", "libLLVM.so.19.1")
    assert find_libllvm({}, folders) == known


def test_the_environment_wins(tmp_path):
    own = library(tmp_path, "mine.so")
    assert find_libllvm({"DRJIT_LIBLLVM_PATH": str(own)}, ()) == own
    assert find_libllvm({"DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}, ()) is None


def test_cgroup_quota(tmp_path):
    assert machine.cpu_quota(tmp_path) is None
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert machine.cpu_quota(tmp_path) is None
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    assert machine.cpu_quota(tmp_path) == 1.5
    (tmp_path / "memory.max").write_text("1048576\n")
    assert machine.memory_bytes(tmp_path) == 1 << 20
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.memory_bytes(tmp_path) > 1 << 20
    assert machine.cpu_count() >= 1


def test_the_kind_of_cpu_is_what_it_multiplies_8_bits_with(monkeypatch):
    for flags, kind in (
        ({"sse2", "avx512_vnni", "amx_int8", "amx_tile"}, "amx"),
        ({"sse2", "avx512_vnni"}, "vnni"),
        ({"sse2", "avx_vnni"}, "vnni"),
        ({"sse2", "avx2"}, platform.machine()),
        (set(), platform.machine()),
    ):
        monkeypatch.setattr(machine, "cpu_flags", lambda found=flags: frozenset(found))
        assert machine.cpu_kind() == kind


def test_engines_are_listed(monkeypatch):
    from deepshade import engines

    (check,) = doctor.check_engines()
    assert check.ok
    assert "onnxruntime (fp32" in check.detail
    monkeypatch.setattr(engines, "available", lambda: ())
    (check,) = doctor.check_engines()
    assert not check.ok
    assert "[service]" in check.fix


def test_a_taken_port_is_a_warning():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        (check,) = doctor.check_port(taken.getsockname()[1])
    assert not check.ok
    assert not check.required
    assert check.fix


def test_a_broken_bundle_is_an_error(tmp_path):
    (check,) = doctor.check_bundles(tmp_path)
    assert not check.required
    folder = tmp_path / "ao" / "default"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    place, check = doctor.check_bundles(tmp_path)
    assert place.detail == str(tmp_path)
    assert check.required
    assert not check.ok


def test_models_that_are_nowhere_are_an_error(monkeypatch):
    monkeypatch.setenv("DEEPSHADE_MODELS", "/nowhere")
    (check,) = doctor.check_bundles()
    assert check.required
    assert not check.ok
    assert "/nowhere" in check.detail


def test_what_was_counted_is_a_number():
    values = {check.name: check.value for check in doctor.check_machine()}
    assert values["CPUs"] == machine.cpu_count()
    assert values["memory"] == machine.memory_bytes()


def test_without_clone_and_wheel_advice_names_the_packages_themselves(monkeypatch):
    monkeypatch.setattr(extras, "__file__", "/site/deepshade/extras.py")
    monkeypatch.setattr(extras, "_origin", lambda: "")
    monkeypatch.setattr(extras, "missing_packages", lambda extra: ["ray", "scipy"])
    advice = extras.install_command("workers")
    assert re.search(r"pip install 'ray\[default\]>=[\d.]+' 'scipy>=[\d.]+'$", advice)


def test_every_failure_has_a_fix_of_one_line(monkeypatch):
    monkeypatch.setattr(doctor, "installed", lambda module: module == "mitsuba")
    monkeypatch.setattr(doctor, "missing_packages", lambda extra: ["thing"])
    monkeypatch.setattr(doctor, "find_libllvm", lambda: None)
    failed = [c for c in doctor.run_checks() if not c.ok]
    assert {"core packages", "libLLVM", "extra 'service'"} <= {c.name for c in failed}
    for check in failed:
        assert check.fix
        assert "\n" not in check.fix


def test_exit_codes(monkeypatch, capsys):
    bad = doctor.Check("thing", False, True, "gone", "fetch it")
    monkeypatch.setattr(doctor, "_CHECKS", (lambda: [bad],))
    assert main(["doctor"]) == 1
    assert "fix: fetch it" in capsys.readouterr().out
    warning = doctor.Check("thing", False, False, "gone", "fetch it")
    monkeypatch.setattr(doctor, "_CHECKS", (lambda: [warning],))
    assert main(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["name"] == "thing"
