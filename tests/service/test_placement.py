"""The service's answer lies exactly where its input lay."""

import numpy as np
import pytest

from deepshade import exr


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
