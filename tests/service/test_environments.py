"""Environment maps through the service: listed, used, turned, added, refused."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.environments import Environment, directions, read_environment, sky
from deepshade.errors import ConfigError
from deepshade_service.config import Settings
from deepshade_trainer.calculated import export_calculated, picture

from .conftest import encode

EXR = {"Content-Type": "image/x-exr"}


def as_exr(environment):
    return encode(dict(zip("RGB", environment.radiance, strict=True)))


@pytest.fixture(scope="module")
def calculated(tmp_path_factory):
    """A models folder with `ibl`."""
    root = tmp_path_factory.mktemp("calculated")
    export_calculated(root / "ibl" / "balanced", "reflections")
    return root


@pytest.fixture
def maps(tmp_path):
    folder = tmp_path / "maps"
    folder.mkdir()
    for name, elevation in (("noon", 80), ("evening", 10)):
        (folder / f"{name}.exr").write_bytes(as_exr(sky(elevation=elevation, height=32)))
    (folder / "notes.txt").write_text("no map")
    (folder / "broken.hdr").write_bytes(b"#?RADIANCE\n\n-Y 8 +X 16\n")
    return folder


@pytest.fixture
def lit(start, calculated, maps):
    return start(models=calculated, environments=maps, environment_uploads=True)


def ball(inputs=EFFECTS["ibl"].inputs, side=40, **attributes):
    planes = iter(picture(side, inputs)[0])
    channels = {channel: next(planes) for name in inputs for channel in ATTRIBUTES[name].channels}
    return encode(channels, attributes=attributes)


def shade(local, body=None, **query):
    return local.client.post("/shade/ibl", params=query, content=body or ball(), headers=EXR)


def pixels(response):
    assert response.status_code == 200, response.text
    return exr.read(response.content).stack("RGB")


@pytest.mark.slow
def test_each_request_has_its_own_environment(lit, maps):
    answers = {}
    for name in ("noon", "evening", "noon"):
        response = shade(lit, environment=name, half="false")
        expected = read_environment(maps / f"{name}.exr").sha256
        assert response.headers["deepshade-environment"] == name
        assert response.headers["deepshade-environment-sha256"] == expected
        assert response.headers["deepshade-rotate"] == "0"
        found = pixels(response)
        np.testing.assert_array_equal(answers.setdefault(name, found), found)
        header = exr.read_header(response.content).parts[0].attributes
        assert header["deepshade:environment_sha256"] == expected
    assert np.abs(answers["noon"] - answers["evening"]).mean() > 0.05


@pytest.mark.slow
def test_the_generated_sky_is_there_without_a_folder(start, calculated):
    local = start(models=calculated)
    (entry,) = local.client.get("/environments").json()
    assert (entry["name"], entry["source"], entry["sha256"]) == ("sky", "generated", None)
    response = shade(local)
    assert response.headers["deepshade-environment"] == "sky"
    assert response.headers["deepshade-environment-sha256"] == sky(height=512).sha256
    assert pixels(response).mean() > 0.1
    assert local.client.post("/environments/more", content=b"", headers=EXR).status_code == 403


@pytest.mark.slow
def test_a_turned_map_is_seen_behind_the_ball(lit, maps):
    """The corner pixel shows what lies there in the map, also after a turn and with z up."""
    environment = read_environment(maps / "noon.exr")
    for query, towards in (
        ({}, lambda d: d),
        ({"rotate": 90}, lambda d: (-d[2], d[1], d[0])),  # what was north is now west
        ({"up": "z"}, lambda d: (d[0], d[2], -d[1])),
    ):
        found = pixels(shade(lit, environment="noon", half="false", **query))[:, 0, 0]
        ray = -picture(40, EFFECTS["ibl"].inputs)[0, 3:6, 0, 0]
        np.testing.assert_allclose(found, environment.sample(np.array(towards(ray))), rtol=0.02)


@pytest.mark.slow
def test_the_shipped_chain_looks_through_the_lens(start, tmp_path):
    """At any size, by default under the sky; blur circles follow from the request's lens."""
    (tmp_path / "full").symlink_to(Path(__file__).parents[2] / "models/full")
    inputs = [name for name in EFFECTS["full"].inputs if name != "focal"]
    local = start(models=tmp_path)

    def shade(body, **query):
        asked = {"radius": 1, "fov": 50, "half": "false", **query}
        return local.client.post("/shade/full", params=asked, content=body, headers=EXR)

    body = ball(inputs, 97)
    sharp = shade(body, focus=1.7, aperture=0)
    assert sharp.headers["deepshade-environment"] == "sky"
    blurred = pixels(shade(body, focus=1, aperture=0.5))
    assert blurred.shape == (3, 97, 97)
    steps = [np.abs(np.diff(image[:, 48, :16])).max() for image in (pixels(sharp), blurred)]
    assert steps[0] > 5 * steps[1]  # the ball's edge against the sky
    assert "deepshade:focus" in shade(body).json()["detail"]


@pytest.mark.slow
def test_a_renderer_whose_worlds_are_z_up(lit):
    response = shade(lit, ball(**{"cycles.x": "1"}), environment="noon")
    assert response.headers["deepshade-up"] == "z"
    asked = shade(lit, ball(**{"cycles.x": "1"}), environment="noon", up="y")
    assert asked.headers["deepshade-up"] == "y"


@pytest.mark.slow
def test_what_is_known_of_maps(lit, maps):
    listed = {entry["name"]: entry for entry in lit.client.get("/environments").json()}
    assert set(listed) == {"broken", "evening", "noon", "sky"}
    assert listed["noon"]["sha256"] is None
    response = lit.client.get(listed["noon"]["thumbnail"])
    assert Image.open(io.BytesIO(response.content)).size == (64, 32)
    (entry,) = (e for e in lit.client.get("/environments").json() if e["name"] == "noon")
    assert (entry["width"], entry["height"]) == (64, 32)
    assert entry["sha256"] == read_environment(maps / "noon.exr").sha256


@pytest.mark.slow
def test_a_map_is_added_and_replaced(lit, maps):
    white = Environment("", np.ones((3, 16, 32), np.float32))
    for environment in (white, sky(height=16)):
        response = lit.client.post("/environments/mine", content=as_exr(environment), headers=EXR)
        assert response.status_code == 201, response.text
        assert response.json()["sha256"] == environment.sha256
        used = shade(lit, environment="mine").headers
        assert used["deepshade-environment-sha256"] == environment.sha256
    assert (maps / "mine.exr").exists()


@pytest.mark.slow
def test_a_map_that_changes_on_disk_is_read_anew(lit, maps):
    """Also in place, with the same size; and a map that stays isn't."""
    environments = lit.service.environments
    before = pixels(shade(lit, environment="noon", half="false"))
    kept = lit.run(environments.get("noon"))
    pixels(shade(lit, environment="noon"))
    assert lit.run(environments.get("noon")) is kept
    seen = lit.client.get("/environments/noon/thumbnail").content
    brighter = sky(elevation=80, height=32).radiance * 2
    (maps / "noon.exr").write_bytes(as_exr(Environment("", brighter)))
    assert lit.client.get("/environments/noon/thumbnail").content == seen  # exposed by the median
    response = shade(lit, environment="noon", half="false")
    np.testing.assert_allclose(pixels(response), 2 * before, rtol=1e-4, atol=1e-5)
    (maps / "noon.exr").unlink()
    assert shade(lit, environment="noon").status_code == 422


@pytest.mark.slow
def test_prepared_maps_are_bounded_in_bytes(start, calculated, maps):
    """A quarter of the memory, which here holds one map and not two; the latest stays."""
    local = start(models=calculated, environments=maps, memory=2**29)
    environments = local.service.environments
    for name in ("noon", "evening", "evening"):
        shade(local, environment=name)
        assert 0 < environments.held <= 2**27
    assert list(environments._prepared) == [read_environment(maps / "evening.exr").sha256]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("query", "said", "fix"),
    [
        ({"environment": "nooon"}, "no environment 'nooon'", "noon"),
        ({"rotate": "nan"}, "rotate", ""),
        ({"up": "x"}, "up", ""),
    ],
)
def test_parameters_that_are_refused(lit, query, said, fix):
    response = shade(lit, **query)
    assert response.status_code == 422
    assert said in response.json()["detail"]
    assert fix in response.json().get("fix", "")


def test_effects_without_an_environment_refuse_one(client, make_exr):
    response = client.post("/shade/ao", params={"rotate": 3}, content=make_exr(4, 4), headers=EXR)
    assert response.status_code == 422
    assert "rotate" in response.json()["detail"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "body", "status", "said"),
    [
        ("map", b"no picture", 400, "neither"),
        ("map", b"#?RADIANCE\n\n-Y 8 +X 16\n12", 400, "scanline"),
        ("map", b"#?RADIANCE\n\n-Y 90000 +X 180000\n12", 413, "pixels"),
        (
            "map",
            encode({"R": np.ones((4, 4)), "G": np.ones((4, 4)), "B": np.ones((4, 4))}),
            422,
            "4 x 4",
        ),
        ("map", encode({"Y": np.full((4, 8), -1.0)}), 422, "row 0"),
        ("sky", as_exr(sky(height=8)), 422, "called"),
        ("..%2Fmap", as_exr(sky(height=8)), 404, ""),
        (".map", as_exr(sky(height=8)), 422, "called"),
    ],
)
def test_maps_that_are_refused(lit, maps, name, body, status, said):
    before = sorted(path.name for path in maps.iterdir())
    response = lit.client.post(f"/environments/{name}", content=body, headers=EXR)
    assert response.status_code == status, response.text
    assert said in response.json()["detail"]
    assert sorted(path.name for path in maps.iterdir()) == before


@pytest.mark.slow
def test_a_broken_file_in_the_folder_spoils_only_itself(lit):
    assert shade(lit, environment="broken").status_code == 400
    assert shade(lit, environment="noon").status_code == 200


@pytest.mark.slow
def test_the_plan_names_the_environment(lit):
    plan = shade(lit, environment="noon", rotate=12.5, explain=1).json()
    assert (plan["environment"], plan["rotate"], plan["up"]) == ("noon", 12.5, "y")


def test_uploads_need_a_folder():
    with pytest.raises(ConfigError, match="folder"):
        Settings(environment_uploads=True)


def test_directions_of_the_ball_are_what_a_camera_sees():
    """The picture that these tests send: its upper left pixel looks up and to the left."""
    ray = -picture(40, EFFECTS["ibl"].inputs)[0, 3:6, 0, 0]
    assert ray[0] < 0 < ray[1]
    assert ray[2] < -0.9
    assert directions(32, 64)[1, 0, 0] > 0
