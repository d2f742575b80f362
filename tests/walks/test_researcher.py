"""`examples/researcher.py`, from the wheel, in small: README's commands for making a shader."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import jsonschema
import pytest
import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.timeout(900)  # about a minute of one core; Ray, Mitsuba and PyTorch start in it
@pytest.mark.usefixtures("outside")
def test_the_commands_make_a_shader(installed: Path, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "models/ao/fast", tmp_path / "models/ao/fast")
    command = [installed / "python", ROOT / "examples" / "researcher.py", "--small"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert done.stdout.count("$ deepshade") >= 8
    bundle = tmp_path / "models/ao/mine"
    assert "| test | exact |" in (bundle / "README.md").read_text()
    # trained on from the shipped weights, with views of the one scene held out
    steps = [
        entry["step"] for entry in json.loads((tmp_path / "runs/mine/metrics.json").read_text())
    ]
    assert steps == [0, 2]
    assert "new views of this scene" in done.stderr
    assert json.loads((tmp_path / "out/report/report.json").read_text())["sections"]["error"]
    assert (tmp_path / "view.exr").is_file()
    assert (tmp_path / "sheet.png").is_file()


def test_ray_takes_the_example_of_a_cluster() -> None:
    """By Ray's own schema, which refuses what it doesn't know."""
    config = yaml.safe_load((ROOT / "examples/cluster.yaml").read_text())
    validate_config(prepare_config(config))
    with pytest.raises(jsonschema.ValidationError):
        validate_config(prepare_config({**config, "hed_node": {}}))
