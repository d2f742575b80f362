"""The service's answer lies exactly where its input lay."""

import io
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from deepshade import exr
from deepshade.exr.entries import Entry

EXR = "image/x-exr"


@pytest.mark.parametrize("query", ["", "?fov=40", "?compression=piz"])
def test_windows_and_placement_are_the_inputs(client, make_exr, query):
    """The display window begins elsewhere than at (0, 0); without fov there is no camera."""
    placing = {
        "pixelAspectRatio": 2.0,
        "screenWindowCenter": (0.25, -0.5),
        "screenWindowWidth": 1.0,
        "worldToCamera": np.diag([1, 1, 1, 1]).astype(np.float32),
    }
    windows = {"data_window": (103, -7, 126, 8), "display_window": (100, -20, 163, 27)}
    body = make_exr(16, 24, attributes=placing, **windows)
    headers = {"Content-Type": "image/x-exr"}
    response = client.post(f"/shade/ao{query}", content=body, headers=headers)
    assert response.status_code == 200, response.text
    part = exr.read_header(response.content).parts[0]
    assert {"data_window": part.data_window, "display_window": part.display_window} == windows
    if query == "?fov=40":
        placing["screenWindowWidth"] = 2 * np.tan(np.radians(20))
    for name, value in placing.items():
        np.testing.assert_allclose(part.attributes[name], value, rtol=1e-6)


@pytest.mark.parametrize("compression", ["zip", "piz"])
def test_entries_of_the_shot_stay(client, make_exr, compression):
    """As OpenEXR's own library reads them; what tells of other pixels doesn't stay."""
    primaries = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
    own = {
        "owner": "someone",
        "comments": "täglich",
        "view": "left",
        "Frame": "0042",
        "Camera": "cam.main",
        "framesPerSecond": Entry("rational", struct.pack("<iI", 24000, 1001)),
        "timeCode": Entry("timecode", struct.pack("<2I", 0x01020304, 7)),
        "keyCode": Entry("keycode", struct.pack("<7i", 1, 2, 3, 4, 5, 4, 64)),
        "chromaticities": Entry("chromaticities", struct.pack("<8f", *primaries)),
        "expTime": 0.02,
        "worldToNDC": np.arange(16, dtype="f").reshape(4, 4),
        "worldToCamera": np.diag(np.float32([1, 1, -1, 1])),  # as Arnold's, which looks down +z
    }
    other = {"cryptomatte/1/manifest": "{}", "aperture": "wide", "focus": float("nan")}
    body = make_exr(8, 8, attributes={**own, **other, "deepshade:fov": 50.0})
    response = client.post(
        f"/shade/ao?compression={compression}", content=body, headers={"Content-Type": EXR}
    )
    assert response.status_code == 200, response.text
    before, after = (OpenEXR.File(io.BytesIO(data)) for data in (body, response.content))
    for name in own:
        expected, found = before.header()[name], after.header()[name]
        if isinstance(expected, np.ndarray):
            np.testing.assert_array_equal(found, expected)
        else:
            assert str(found) == str(expected), name
    assert str(after.header()["framesPerSecond"]) == "24000/1001"
    assert after.header().keys().isdisjoint(other)
    assert after.channels()["Y"].pixels.shape == (8, 8)


@pytest.mark.parametrize("name", ["header_rich", "win_t05_display_inside"])
def test_files_of_others(client, name):
    """Windows, placement and the shot's entries are the input's."""
    body = (Path(__file__).parents[1] / "cases" / f"{name}.exr").read_bytes()
    url = "/shade/ao?radius=0.5"
    answer = client.post(url, content=body, headers={"Content-Type": "image/x-exr"})
    assert answer.status_code == 200, answer.text
    there, found = (exr.read_header(data).parts[0] for data in (body, answer.content))
    assert found.data_window == there.data_window
    assert found.display_window == there.display_window
    assert found.entries == there.entries
    for key in ("pixelAspectRatio", "screenWindowCenter", "worldToCamera"):
        np.testing.assert_allclose(found.attributes[key], there.attributes[key], rtol=1e-6)
