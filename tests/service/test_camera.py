"""The camera's matrix by hand, for renderers that write none."""

import numpy as np
import pytest

from deepshade import exr
from deepshade.camera import Camera, parse_matrix
from deepshade.errors import CameraError

EXR = {"Content-Type": "image/x-exr"}
LOOK = Camera.look_at((3, 2, 5), (0, 1, 0), (0, 0, 1), 50, 8, 8).matrix
TEXT = ",".join(map(repr, LOOK.ravel().tolist()))


@pytest.mark.parametrize(
    "text",
    [TEXT, TEXT.replace(",", " "), str(LOOK.tolist()), ",".join(TEXT.split(",")[:12])],
)
def test_rows_in_whatever_brackets(text):
    np.testing.assert_array_equal(parse_matrix(text), LOOK)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "16 numbers"),
        ("1,2,x", "16 numbers"),
        (",".join(map(str, np.eye(3).ravel())), "where the camera is"),
        (",".join(map(str, LOOK.T.ravel())), "transposed"),
        (",".join(["nan"] * 16), "finite"),
        (",".join(["0"] * 15 + ["1"]), "inverted"),
    ],
)
def test_no_matrix(client, make_exr, text, said):
    with pytest.raises(CameraError, match=said):
        parse_matrix(text)
    response = client.post(
        "/shade/ao", params={"world_to_camera": text}, content=make_exr(4, 4), headers=EXR
    )
    assert response.status_code == 422
    assert said in response.json()["detail"]
    assert "Value error" not in response.json()["detail"]


def test_world_normals_are_used_as_with_a_matrix_in_the_header(client, make_picture, make_exr):
    """Blender's: world-space normals and depth, and no camera in the header."""
    view = make_picture(32, 48)
    normals = np.stack([view[f"normal.{axis}"] for axis in "XYZ"])
    world = np.einsum("ji,jhw->ihw", LOOK[:3, :3], normals).astype("f")
    blender = {f"View.Normal.{axis}": plane for axis, plane in zip("XYZ", world, strict=True)}
    blender["View.Depth.Z"] = -view["position.Z"]
    marks = {"cycles.View.samples": "64", "deepshade:fov": 50.0}

    def shade(header, query):
        body = make_exr(blender, attributes=header)
        query = {"half": False, **query}
        response = client.post("/shade/ao", params=query, content=body, headers=EXR)
        assert response.status_code == 200, response.text
        return response

    without = shade(marks, {})
    assert "need worldToCamera" in without.headers["deepshade-derived"]
    hand = shade(marks, {"world_to_camera": TEXT})
    written = shade({**marks, "worldToCamera": LOOK.T.astype("f")}, {})
    assert "from world-space normals" in hand.headers["deepshade-derived"]
    pixels = [exr.read(answer.content).pixels["Y"] for answer in (hand, written, without)]
    np.testing.assert_array_equal(pixels[0], pixels[1])
    assert np.abs(pixels[0] - pixels[2]).max() > 0.01
    own = exr.read_header(hand.content).parts[0].attributes["worldToCamera"]
    np.testing.assert_array_equal(own, LOOK.T.astype("f"))
