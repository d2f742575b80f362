"""An answer lies exactly where its input lay: windows, pixel aspect, screen window, matrix."""

import io

import numpy as np
import OpenEXR
import pytest

from deepshade import exr
from deepshade.camera import placement_of
from deepshade.gbuffer import load_gbuffer

PLACING = {
    "pixelAspectRatio": 2.0,
    "screenWindowCenter": (0.25, -0.5),
    "screenWindowWidth": 1.0,  # the value of programs that know nothing: no field of view
    "worldToCamera": np.eye(4, dtype=np.float32)[[0, 2, 1, 3]] * np.float32(-1) + 0.0,
}
PLACING["worldToCamera"][3, 3] = 1
NEEDS = ("normal", "position")


def channels(height=4, width=6):
    planes = {f"normal.{axis}": np.zeros((height, width), np.float32) for axis in "XYZ"}
    planes |= {f"position.{axis}": np.zeros((height, width), np.float32) for axis in "XYZ"}
    planes["normal.Z"] += 1
    planes["position.Z"] -= 3
    return planes


def body_of(attributes, **windows):
    stream = io.BytesIO()
    exr.write(stream, channels(), attributes=attributes, **windows)
    return stream.getvalue()


@pytest.mark.parametrize("fov", [None, 40.0])
def test_an_answer_lies_where_its_input_lay(fov):
    """Written with the G-buffer's windows and placement, a header says what the input's said."""
    windows = {"data_window": (103, -7, 108, -4), "display_window": (100, -20, 131, -1)}
    gbuffer = load_gbuffer(body_of(PLACING, **windows), NEEDS, fov=fov)
    assert (gbuffer.camera is None) == (fov is None)
    stream = io.BytesIO()
    exr.write(
        stream,
        {"Y": np.ones(gbuffer.shape)},
        attributes=gbuffer.placement(),
        data_window=gbuffer.data_window,
        display_window=gbuffer.display_window,
    )
    part = exr.read_header(stream.getvalue()).parts[0]
    assert part.data_window == windows["data_window"]
    assert part.display_window == windows["display_window"]
    for name, value in PLACING.items():
        if name == "screenWindowWidth" and fov is not None:
            value = 2 * np.tan(np.radians(fov) / 2)
        np.testing.assert_allclose(part.attributes[name], value, rtol=1e-6, err_msg=name)


def test_of_several_parts_the_shaded_one_counts():
    """A beauty pass with a camera of its own comes first."""
    header = {"type": OpenEXR.scanlineimage}
    other = {"worldToCamera": np.diag([1, 1, 1, 1]).astype("f"), "screenWindowWidth": 1.0}
    beauty = {name: np.ones((4, 6), np.float32) for name in "RGB"}
    mine = PLACING | {"screenWindowCenter": np.float32([0.25, -0.5])}
    parts = [
        OpenEXR.Part(header | mine | other, beauty, "beauty"),
        OpenEXR.Part(header | mine, channels(), "data"),
    ]
    stream = io.BytesIO()
    OpenEXR.File(parts).write(stream)
    found = load_gbuffer(stream.getvalue(), NEEDS).placement()
    np.testing.assert_array_equal(found["worldToCamera"], PLACING["worldToCamera"])
    assert found["pixelAspectRatio"] == 2


@pytest.mark.parametrize(
    "attributes",
    [
        {"pixelAspectRatio": 0.0},
        {"pixelAspectRatio": float("nan")},
        {"screenWindowWidth": -1.0},
        {"screenWindowCenter": (0.0, float("inf"))},
        {"worldToCamera": "camera1"},
        {"worldToCamera": np.full((4, 4), np.nan)},
        {"worldToCamera": np.eye(3)},
        {},
    ],
)
def test_what_no_answer_could_hold_is_left_out(attributes):
    assert placement_of(attributes) == {}
