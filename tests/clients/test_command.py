"""`deepshade-client`: which files go where, what is printed, and exit codes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from deepshade import exr
from deepshade.pictures import texts_of
from deepshade_client import batch, report
from deepshade_client.batch import UsageError, plan
from deepshade_client.cli import main


@pytest.fixture
def run(service, capsys, monkeypatch):
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DEEPSHADE_SERVER", str(service.client.base_url))

    def run(*arguments, code=0):
        found = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert found == code, err
        return out, err

    return run


@pytest.fixture
def views(tmp_path, make_exr):
    """Three small pictures, one in a subfolder, and a file that is none."""
    folder = tmp_path / "in"
    (folder / "deep").mkdir(parents=True)
    for name, width in (("a", 4), ("b", 5), ("deep/c", 6)):
        (folder / f"{name}.exr").write_bytes(make_exr(4, width))
    (folder / "notes.txt").write_text("hello")
    return folder


def targets(tasks):
    return [str(task.target) for task in tasks]


class TestPlan:
    def plan(self, inputs, out, **options):
        return plan(
            [str(i) for i in inputs], str(out), **({"effect": "ao", "suffix": ".exr"} | options)
        )

    def test_one_file(self, views, tmp_path):
        (task,) = self.plan([views / "a.exr"], tmp_path / "x.exr")
        assert task.sources == (views / "a.exr",)
        assert task.target == tmp_path / "x.exr"

    def test_folder_keeps_names_and_subfolders(self, views, tmp_path):
        tasks = self.plan([views], tmp_path / "out", suffix=".png")
        names = [str(task.target.relative_to(tmp_path / "out")) for task in tasks]
        assert names == ["a.png", "b.png", "deep/c.png"]

    def test_glob(self, views, tmp_path):
        tasks = self.plan([views / "**" / "*.exr"], f"{tmp_path}/out/")
        assert [task.target.name for task in tasks] == ["a.exr", "b.exr", "c.exr"]

    def test_pattern(self, views, tmp_path):
        tasks = self.plan([views / "a.exr", views / "b.exr"], tmp_path / "{name}_{effect}.exr")
        assert [task.target.name for task in tasks] == ["a_ao.exr", "b_ao.exr"]

    def test_a_number_sign_in_a_folder_is_no_frame(self, views, tmp_path):
        (views / "a.0007.exr").write_bytes(b"")
        for out in ("take#2/", "take#2/x.##.exr"):
            (task,) = self.plan([views / "a.0007.exr"], f"{tmp_path}/{out}")
            assert task.target.parent == tmp_path / "take#2"

    def test_the_same_file_twice_is_shaded_once(self, views, tmp_path):
        assert len(self.plan([views / "a.exr", views / "a.exr"], f"{tmp_path}/out/")) == 1

    def test_together(self, views, tmp_path):
        (task,) = self.plan([views / "a.exr", views / "b.exr"], tmp_path / "x.exr", together=True)
        assert [path.name for path in task.sources] == ["a.exr", "b.exr"]

    def test_outputs_within_the_input_folder_are_no_inputs(self, views):
        out = views / "out"
        out.mkdir()
        (out / "a.exr").write_bytes(b"earlier")
        assert len(self.plan([views], out)) == 3

    @pytest.mark.parametrize(
        ("inputs", "out", "message"),
        [
            (["a.exr", "b.exr"], "x.exr", "can't all go to the file"),
            (["a.exr"], "a.exr", "is an input"),
            (["a.exr"], "deep/../a.exr", "is an input"),
            (["."], ".", "is an input"),
            (["a.exr", "deep"], "same.exr/../{effect}.exr", "would both go"),
            (["none.exr"], "x.exr", "no file, folder or match"),
            (["*.hdr"], "x.exr", "no file, folder or match"),
            (["a.exr"], "{nmae}.exr", "can't be filled in"),
            (["a.exr"], "{0}.exr", "can't be filled in"),
        ],
    )
    def test_refused(self, views, monkeypatch, inputs, out, message):
        monkeypatch.chdir(views)
        with pytest.raises(UsageError, match=message):
            self.plan(inputs, out)

    def test_a_folder_without_pictures(self, tmp_path):
        with pytest.raises(UsageError, match=r"no \.exr files"):
            self.plan([tmp_path], tmp_path / "x")

    def test_a_link_to_an_input_is_an_input(self, views):
        (views / "link.exr").symlink_to(views / "a.exr")
        with pytest.raises(UsageError, match="is an input"):
            self.plan([views / "a.exr"], views / "link.exr")


def test_shade_one(run, views, tmp_path):
    _, err = run("shade", "ao", views / "a.exr", "-o", tmp_path / "x.exr", "--radius", "0.3")
    assert "✓" in err
    header = exr.read_header(tmp_path / "x.exr").parts[0]
    assert header.shape == (4, 4)
    assert header.attributes["deepshade:radius"] == pytest.approx(0.3)


def test_shade_a_folder_as_json(run, views, tmp_path):
    out, err = run("shade", "ao", views, "-o", tmp_path / "out", "--json", "--float", "-j", "2")
    assert err == ""
    document = json.loads(out)
    assert (document["saved"], document["failed"]) == (3, 0)
    for entry, width in zip(document["pictures"], (4, 5, 6), strict=True):
        assert entry["ok"]
        assert entry["facts"]["bundle"] == "tiny"
        assert isinstance(entry["facts"]["radius"], float)
        assert entry["facts"]["background_pixels"] == 0
        assert isinstance(entry["facts"]["bundle_sha256"], str)
        assert set(entry["milliseconds"]) == {"decode", "plan", "infer", "encode"}
        part = exr.read_header(entry["output"]).parts[0]
        assert part.shape == (4, width)
        assert part.channels == {"Y": "float"}


@pytest.mark.parametrize(
    ("name", "text", "fact"),
    [
        ("tiles", "12", 12),
        ("gi.radius", "1e-05", 1e-5),
        ("bundle_sha256", "123456789012", "123456789012"),
        ("ao.bundle", "7", "7"),
        ("environment", "2024", "2024"),
        ("layer", "001", "001"),
        ("dssim", "nan", "nan"),
        ("derived", "position from depth", "position from depth"),
    ],
)
def test_numbers_in_json_are_numbers_and_names_stay_names(name, text, fact):
    assert report.number(name, text) == fact


def test_every_help_has_an_example_and_every_command_a_version(run):
    for name in ("shade", "effects", "environments", "models"):
        assert f"deepshade-client {name} " in " ".join(run(name, "--help")[0].split())
        assert run(name, "--version")[0].startswith("deepshade 0.")


def test_explain_prints_the_plan_and_saves_nothing(run, views):
    before = sorted(views.rglob("*"))
    out, _ = run("shade", "ao", views, "--explain", "--engine", "onnxruntime", "--radius", "0.2")
    pictures = json.loads(out)["pictures"]
    assert [len(entry["input"]) for entry in pictures] == [1, 1, 1]
    for entry, width in zip(pictures, (4, 5, 6), strict=True):
        plan = entry["plan"]
        assert plan["bundle"] == "tiny"
        assert plan["asked"] == {"engine": "onnxruntime"}
        assert plan["radius"] == 0.2
        assert plan["pixels"]["width"] == width
    assert sorted(views.rglob("*")) == before


def test_what_chooses_the_bundle_reaches_the_service(run, views, tmp_path):
    arguments = ["shade", "ao", views / "a.exr", "-o", tmp_path / "x.exr"]
    run(*arguments, "--precision", "fp32", "--max-error", "0.5")
    plan = json.loads(exr.read_header(tmp_path / "x.exr").parts[0].attributes["deepshade:plan"])
    assert plan["asked"] == {"precision": "fp32", "max_error": 0.5}
    _, err = run(*arguments, "--quality", "best", code=1)
    assert "no bundle 'best'" in err
    _, err = run(*arguments, "--budget-ms", "1e-6", code=1)
    assert "in 1e-06 ms" in err
    _, err = run("shade", "ao", views / "a.exr", code=2)
    assert "--out" in err


@pytest.mark.parametrize(("option", "name"), [(["--png"], "x"), ([], "x.png")])
def test_png(run, views, tmp_path, option, name):
    run("shade", "ao", views / "a.exr", "-o", tmp_path / name, *option)
    assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("out", ["x.exr", "x.tif", "{name}.jpg"])
def test_the_suffix_says_what_the_answer_is(run, views, tmp_path, out):
    arguments = ["shade", "ao", views / "a.exr", "-o", tmp_path / out]
    _, err = run(*arguments, "--png", code=2)
    assert ("--png makes PNGs" if out == "x.exr" else "write .exr or .png") in err
    assert not (tmp_path / out).exists()


@pytest.fixture
def frames(tmp_path, make_exr, make_picture):
    """Three frames of two files each."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for name in ("normal", "position"):
        channels = {k[-1]: v for k, v in make_picture(4, 6).items() if k.startswith(name)}
        for frame in (1, 2, 3):
            (folder / f"s_{name}.{frame:04d}.exr").write_bytes(make_exr(channels))
    return folder


def test_a_sequence_of_a_file_an_attribute(run, frames, tmp_path):
    inputs = [frames / f"s_{name}.%04d.exr" for name in ("normal", "position")]
    _, err = run("shade", "ao", *inputs, "-o", tmp_path / "ao.####.exr")
    assert "s: 3 frames, 2 files a frame: normal, position" in err
    assert "3 saved" in err
    saved = sorted(path.name for path in tmp_path.glob("ao.*"))
    assert saved == ["ao.0001.exr", "ao.0002.exr", "ao.0003.exr"]
    assert exr.read_header(tmp_path / "ao.0002.exr").parts[0].shape == (4, 6)
    (frames / "s_position.0002.exr").unlink()
    _, err = run("shade", "ao", frames, "-o", f"{tmp_path}/out/", code=1)
    assert "s_normal.0002.exr: there is no file of its position" in err
    assert "2 saved, 1 failed" in err
    out, _ = run("shade", "ao", frames / "s_*.0001.exr", "--explain")
    assert [len(each["input"]) for each in json.loads(out)["pictures"]] == [2]
    _, err = run("shade", "ao", frames, "-o", f"{tmp_path}/x/", "--apart", "--json", code=1)
    assert err.count("✗") == 3  # normals alone are no G-buffer; positions are


def test_what_is_done_is_skipped(run, frames, tmp_path):
    arguments = ["shade", "ao", frames, "-o", f"{tmp_path}/out/", "--skip-existing"]
    run(*arguments)
    first, second, third = sorted((tmp_path / "out").iterdir())
    made = {path: path.stat().st_mtime_ns for path in (first, second, third)}
    first.write_bytes(first.read_bytes()[:-1])  # not whole
    later = made[second] + 1
    os.utime(frames / "s_position.0002.exr", ns=(later, later))
    _, err = run(*arguments)
    assert "2 saved, 1 skipped" in err
    assert first.stat().st_mtime_ns > made[first]
    assert second.stat().st_mtime_ns > made[second]
    assert third.stat().st_mtime_ns == made[third]
    _, err = run("shade", "ao", frames, "-o", f"{tmp_path}/png/", "--png")
    _, err = run("shade", "ao", frames, "-o", f"{tmp_path}/png/", "--png", "--skip-existing")
    assert "3 skipped" in err


def test_a_sequence_has_one_radius(run, make_exr, make_picture, tmp_path):
    for frame in (1, 2, 3):
        picture = {name: frame * plane for name, plane in make_picture(4, 6).items()}
        (tmp_path / f"s.{frame:04d}.exr").write_bytes(make_exr(picture))
    out = tmp_path / "out.####.exr"

    def radii(*options, code=0):
        run("shade", "ao", tmp_path / "s.####.exr", "-o", out, *options, code=code)
        headers = [exr.read_header(path) for path in sorted(tmp_path.glob("out.*"))]
        return [header.parts[0].attributes["deepshade:radius"] for header in headers]

    first = radii()[0]
    assert radii() == [first] * 3
    (tmp_path / "out.0003.exr").unlink()
    assert radii("--skip-existing") == [first] * 3
    assert radii("--radius", "15%") == [first] * 3
    for path in tmp_path.glob("out.*"):
        path.unlink()
    pngs = tmp_path / "pngs"
    for _ in range(2):  # PNGs remember it too
        run("shade", "ao", tmp_path / "s.####.exr", "-o", f"{pngs}/", "--png", "--skip-existing")
        made = [texts_of(path.read_bytes()) for path in sorted(pngs.iterdir())]
        assert [json.loads(texts["deepshade:plan"])["radius"] for texts in made] == [
            pytest.approx(first)
        ] * 3
        (pngs / "s.0003.png").unlink()
    (tmp_path / "s.0001.exr").write_bytes(b"damaged")
    assert radii(code=1) == [pytest.approx(2 * first, rel=1e-3)] * 2  # of the first one shaded


def test_no_frame_number(run, views, tmp_path):
    _, err = run("shade", "ao", views / "a.exr", "-o", tmp_path / "x.%04d.exr", code=2)
    assert "a.exr has no frame number" in err


def test_append_and_multiply(run, make_exr, make_picture, tmp_path):
    shot, out = tmp_path / "shot.exr", tmp_path / "x.exr"
    picture = make_picture(4, 6)
    shot.write_bytes(make_exr(picture | {f"mine.{c}": picture["normal.Z"] for c in "RGB"}))
    run("shade", "ao", shot, "-o", out, "--append", "--layer", "AO")
    assert exr.read_header(out).parts[0].channels.keys() == {
        *exr.read_header(shot).parts[0].channels,
        "AO.Y",
    }
    _, err = run("shade", "ao", shot, "-o", out, "--multiply", "--map", "beauty=mine")
    assert "multiplied onto mine.R, mine.G, mine.B" in err
    assert exr.read_header(out).parts[0].channels.keys() == set("RGB")


def test_together(run, make_exr, make_picture, tmp_path):
    for name in ("normal", "position"):
        channels = {k[-1]: v for k, v in make_picture(4, 4).items() if k.startswith(name)}
        (tmp_path / f"{name}.exr").write_bytes(make_exr(channels))
    inputs = [tmp_path / "normal.exr", tmp_path / "position.exr"]
    run("shade", "ao", *inputs, "-o", tmp_path / "x.exr", "--together")
    assert exr.read_header(tmp_path / "x.exr").parts[0].shape == (4, 4)


def test_one_bad_picture_does_not_stop_the_others(run, views, tmp_path):
    (views / "b.exr").write_bytes(b"hello")
    out, err = run("shade", "ao", views, "-o", tmp_path / "out", "--json", code=1)
    document = json.loads(out)
    assert [entry["ok"] for entry in document["pictures"]] == [True, False, True]
    assert document["pictures"][1]["error"]["status"] == 400
    assert "not an OpenEXR image" in err
    assert not (tmp_path / "out" / "b.exr").exists()


def test_map_and_problems_with_their_fix(run, views, tmp_path):
    _, err = run("shade", "aoo", views / "a.exr", "-o", tmp_path / "x.exr", code=1)
    assert "did you mean 'ao'?" in err
    _, err = run("shade", "ao", views / "a.exr", "-o", tmp_path / "x.exr", "--focus", 3, code=1)
    assert "'ao' has no setting 'focus'" in err
    assert "dof, full" in err
    _, err = run("shade", "ao", views / "a.exr", "-o", "x.exr", "--raduis", "3", code=2)
    assert "--radius" in err
    _, err = run("shade", "ao", views / "a.exr", "-o", "x.exr", "--map", "normal", code=2)
    assert "attribute=channel" in err
    _, err = run("shade", "ao", views / "a.exr", "-o", views / "a.exr", code=2)
    assert "is an input" in err
    assert "fix:" in err


def test_nobody_there(run, views, tmp_path):
    arguments = ("shade", "ao", views, "-o", tmp_path / "out", "--server", "http://127.0.0.1:9")
    out, err = run(*arguments, "--retries", "0", "--jobs", "1", "--json", code=3)
    errors = [entry["error"]["detail"] for entry in json.loads(out)["pictures"]]
    assert "can't connect" in errors[0]
    assert errors[1] == errors[2] == "not tried: the batch ended early"
    counts = {name: json.loads(out)[name] for name in ("saved", "failed", "skipped", "not_tried")}
    assert counts == {"saved": 0, "failed": 1, "skipped": 0, "not_tried": 2}
    _, err = run(*arguments, "--retries", "1", "--jobs", "1", code=3)
    assert err.index("trying again") < err.index("✗")
    assert "1 failed, 2 not tried" in err
    _, err = run("effects", "--server", "http://127.0.0.1:9", code=3)
    assert "deepshade serve" in err


def test_effects_and_models(run):
    out, _ = run("effects")
    assert "Ambient occlusion" in out
    assert "tiny" in out
    for said in ("--radius", "scene units", "deepshade:radius, else 15%", "--environment"):
        assert said in " ".join(out.split())
    out, _ = run("models", "--json")
    (model,) = json.loads(out)
    assert (model["effect"], model["name"]) == ("ao", "tiny")
    out, _ = run("models")
    assert "tiny" in out


def test_several_are_in_flight(start, views, tmp_path, monkeypatch):
    import asyncio
    import threading

    from deepshade_client import AsyncClient, Options

    local = start(workers=3)
    engine = local.engine()
    barrier, predict = threading.Barrier(3, timeout=10), engine.predict
    engine.predict = lambda gbuffer: (barrier.wait(), predict(gbuffer))[1]
    tasks = plan([str(views)], str(tmp_path / "out"), effect="ao", suffix=".exr")

    async def work():
        async with AsyncClient(str(local.client.base_url)) as client:
            # so large a radius that pixels lie within it: else nothing has to be computed
            options = Options(radius=50)
            return await batch.run(client, "ao", tasks, options, jobs=3, done=lambda result: None)

    assert all(result.error is None for result in asyncio.run(work()))


@pytest.mark.slow
def test_ctrl_c_leaves_no_half_files(start, views, tmp_path):
    """The service never answers; the command stops at once and says so."""
    import threading

    local = start(workers=1)
    gate = threading.Event()
    engine = local.engine()
    predict = engine.predict
    engine.predict = lambda gbuffer: (gate.wait(20), predict(gbuffer))[1]
    out = tmp_path / "out"
    code = "import sys; from deepshade_client.cli import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "shade", "ao", str(views), "-o", str(out), "--radius", "50"],
        env=os.environ | {"DEEPSHADE_SERVER": str(local.client.base_url), "NO_PROXY": "*"},
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 20
    while not local.service.workers.taken:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=10)
    gate.set()
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "interrupted, 3 not tried" in err
    assert "--skip-existing" in err
    assert not out.exists() or not list(out.rglob("*"))


def test_imports_core_only():
    code = (
        "import sys, deepshade_client, deepshade_client.cli;"
        "print([m for m in sys.modules if m.startswith(('deepshade_', 'torch', 'onnx', 'fastapi'))"
        " and not m.startswith('deepshade_client')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_wrong_address_and_a_wrong_mapping_are_no_tracebacks(run, views, tmp_path):
    assert "no address" in run("effects", "--server", "http://a:b", code=2)[1]
    arguments = ["shade", "ao", views / "a.exr", "-o", tmp_path / "x.exr", "--map", "normal"]
    assert "'normal' is no attribute=channel pair" in run(*arguments, code=2)[1]
