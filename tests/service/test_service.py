"""Routes around the shading, the set-up, and how the process starts and stops."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
import threading
import time

import httpx
import pytest

from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DeepshadeError
from deepshade_service.cli import listen
from deepshade_service.config import Settings
from deepshade_service.middleware import Counting
from deepshade_service.telemetry import Telemetry


def test_effects(client):
    effects = client.get("/effects").json()
    assert [effect["name"] for effect in effects] == list(EFFECTS)
    ao = client.get("/effects/ao").json()
    assert ao in effects
    assert [entry["attribute"] for entry in ao["inputs"]] == ["normal", "position"]
    (bundle,) = ao["bundles"]
    assert bundle["name"] == "tiny"
    assert bundle["metrics"] == {"error": {"test-real": {"exact": {"dssim": 0.25}}}}
    assert bundle["dssim"] == 0.25
    assert bundle["radius"] == 0.5
    assert bundle["times"] == []
    (radius,) = ao["settings"]
    assert (radius["name"], radius["unit"]) == ("radius", "scene units")
    assert (radius["header"], radius["default"]) == ("deepshade:radius", "15% of the median depth")
    by_name = {effect["name"]: effect for effect in effects}
    settings = {setting["name"]: setting for setting in by_name["full"]["settings"]}
    assert list(settings) == ["radius", "focus", "aperture", "environment", "rotate", "up"]
    assert (settings["aperture"]["lowest"], settings["aperture"]["default"]) == (0, None)
    assert (settings["environment"]["header"], settings["environment"]["default"]) == (None, "sky")


def test_a_setting_s_range_is_the_parameter_s(client):
    """What GET /effects says is what a request may say."""
    parameters = client.get("/openapi.json").json()["paths"]["/shade/{effect}"]["post"][
        "parameters"
    ]
    schemas = {parameter["name"]: parameter["schema"] for parameter in parameters}
    for effect in client.get("/effects").json():
        for setting in effect["settings"]:
            kinds = schemas[setting["name"]].get("anyOf", [schemas[setting["name"]]])
            assert setting["lowest"] == kinds[0].get("minimum")
            assert setting["highest"] == kinds[0].get("maximum")


def test_published_times_are_those_of_the_backend(start, tmp_path, make_bundle):
    make_bundle(tmp_path / "ao" / "timed")
    path = tmp_path / "ao" / "timed" / "metrics.json"
    both = {"onnxruntime/fp32": 12.5, "openvino/bf16": 3.0}
    path.write_text(json.dumps({"speed": {"a CPU": {"size": [768, 512], "ms": both}}}))
    (bundle,) = start(models=tmp_path).client.get("/effects/ao").json()["bundles"]
    assert bundle["times"] == [{"machine": "a CPU", "size": [768, 512], "ms": 12.5}]
    assert (bundle["engine"], bundle["precision"]) == ("onnxruntime", "fp32")


def test_schema_and_pages(client):
    schema = client.get("/openapi.json").json()
    post = schema["paths"]["/shade/{effect}"]["post"]
    names = {parameter["name"] for parameter in post["parameters"]}
    wanted = {
        "effect",
        "radius",
        "focus",
        "aperture",
        "shutter",
        "environment",
        "rotate",
        "up",
        "world_to_camera",
        "fov",
        "profile",
        "map",
        "bundle",
        "quality",
        "max_error",
        "budget_ms",
        "engine",
        "precision",
        "explain",
        "format",
        "compression",
        "half",
        "append",
        "layer",
        "multiply",
        "axes",
        "normals",
        "depth",
        "near",
        "far",
        "derive",
        "strict",
        "trust",
        "view",
        "projection",
        "ortho_width",
        "upload",
    }
    assert names == wanted
    assert {"image/x-exr", "multipart/form-data"} <= set(post["requestBody"]["content"])
    assert {"200", "400", "404", "413", "415", "422", "429", "503"} <= set(post["responses"])
    assert "swagger" in client.get("/docs").text
    assert "app.js" in client.get("/").text


def test_metrics_count_by_route_not_by_path(client, make_exr):
    client.post("/shade/ao", content=make_exr(4, 4), headers={"Content-Type": "image/x-exr"})
    client.get("/made/up/path")
    text = client.get("/metrics").text
    assert 'deepshade_requests_total{route="/shade/{effect}",status="200"}' in text
    assert "made" not in text
    assert 'deepshade_stage_seconds_count{effect="ao",stage="infer"}' in text
    assert 'deepshade_computed_pixels_total{effect="ao"}' in text
    assert "deepshade_resident_bytes" in text


@pytest.mark.parametrize("begun", [False, True])
def test_a_failure_is_counted_once(begun):
    """Also one after the answer has begun, whose status is known by then."""
    telemetry = Telemetry(queued=lambda: 0, held=lambda: 0)

    async def broken(scope, receive, send):
        if begun:
            await send({"type": "http.response.start", "status": 200, "headers": []})
        raise RuntimeError

    async def send(message):
        pass

    with pytest.raises(RuntimeError):
        asyncio.run(Counting(broken, telemetry)({"type": "http"}, None, send))
    counted = re.findall(r'requests_total{.*status="(\d+)"} (\S+)', telemetry.render().decode())
    assert counted == [("200" if begun else "500", "1.0")]


def test_import_is_light():
    code = (
        "import sys, deepshade_service, deepshade_service.app, deepshade_service.cli;"
        "print([m for m in ('torch', 'ray', 'mitsuba', 'onnx', 'PIL') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_command_imports_light():
    code = (
        "import sys, deepshade_service.cli;"
        "print([m for m in ('fastapi', 'onnxruntime', 'uvicorn') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_settings_name_the_key():
    with pytest.raises(ConfigError, match="'workers' must be at least 1"):
        Settings(workers=0)


def test_a_taken_port_is_an_error_with_a_fix():
    with (
        listen("127.0.0.1", 0) as listener,
        pytest.raises(DeepshadeError, match="can't listen") as caught,
    ):
        listen("127.0.0.1", listener.getsockname()[1])
    assert "--port" in caught.value.fix


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_finish_requests_and_end_cleanly(start_server, make_exr, number):
    server = start_server()
    results = []

    def post(body):
        response = httpx.post(
            f"{server.url}/shade/ao",
            content=body,
            headers={"Content-Type": "image/x-exr"},
            trust_env=False,
            timeout=30,
        )
        results.append(response.status_code)

    post(make_exr(4, 4))  # what Ctrl-C finds loading is given up
    results.clear()
    thread = threading.Thread(target=post, args=[make_exr(900, 900)])
    idle = httpx.Client(trust_env=False)
    idle.get(f"{server.url}/healthz")  # an open connection must not hold the end up
    thread.start()
    while "deepshade_jobs 0.0" in idle.get(f"{server.url}/metrics").text and not results:
        time.sleep(0.002)
    assert server.stop(number) == 0
    thread.join()
    idle.close()
    assert results == [200]


@pytest.mark.slow
def test_serve_without_models_folder_is_a_usage_error(tmp_path):
    command = [
        sys.executable,
        "-c",
        "import sys; from deepshade.cli import main; sys.exit(main())",
        "serve",
    ]
    done = subprocess.run(
        [*command, "--models", str(tmp_path / "none")], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "there is no folder" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--log-level", "foo"], "'foo'"),
        (["--max-uploads", "1M", "--max-body", "1M"], "--max-uploads"),
        (["--models", "/nowhere"], "/nowhere"),
        (["--max-body", "much"], "'much'"),
        (["--engine", "abacus"], "abacus"),
    ],
)
def test_wrong_options_are_no_tracebacks(models, capsys, options, message):
    from deepshade.cli import main

    assert main(["serve", "--models", str(models), *options]) == 2
    assert message in capsys.readouterr().err
