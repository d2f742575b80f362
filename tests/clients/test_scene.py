"""What a user says of his scene: its scale, its camera; and what the command says back."""

import numpy as np
import pytest

from deepshade_client import Options
from deepshade_client.cli import main
from deepshade_client.report import as_options


def test_a_matrix_goes_row_by_row():
    matrix = np.arange(16.0).reshape(4, 4) / 3
    (name, text), *rest = Options(world_to_camera=matrix).query()
    assert (name, rest) == ("world_to_camera", [])
    np.testing.assert_array_equal(np.reshape([float(n) for n in text.split(",")], (4, 4)), matrix)
    assert Options(world_to_camera="1 2", radius="10%").query() == [
        ("radius", "10%"),
        ("world_to_camera", "1 2"),
    ]


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("if 'N' is it: ?map=normal=N", "if 'N' is it: --map normal=N"),
        ("give it (?world_to_camera=), or write", "give it (--world-to-camera), or write"),
        ("the nearest is ?radius=1e-30", "the nearest is --radius 1e-30"),
        ("is it there?", "is it there?"),
    ],
)
def test_fixes_name_options(said, shown):
    assert as_options(said) == shown


def test_the_command_says_what_radius_and_warns(service, capsys, monkeypatch, tmp_path, make_exr):
    monkeypatch.setenv("DEEPSHADE_SERVER", str(service.client.base_url))
    monkeypatch.setenv("NO_PROXY", "*")
    path = tmp_path / "a.exr"
    path.write_bytes(make_exr(8, 8))
    shade = ["shade", "ao", str(path), "-o", str(tmp_path / "out.exr")]
    camera = ["--world-to-camera", "1 0 0 0  0 1 0 0  0 0 1 -5"]
    assert main([*shade, *camera]) == 0
    said = capsys.readouterr().err
    assert "15% of the median depth" in said
    assert "err beyond" not in said
    assert main([*shade, "--radius", "300%"]) == 0
    assert "err beyond: --radius 15% is" in capsys.readouterr().err
