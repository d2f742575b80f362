"""Properties of what headers and mappings say, whatever they say."""

from __future__ import annotations

import io
import math
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from deepshade import exr
from deepshade.camera import Camera, parse_matrix, placement_of
from deepshade.errors import CameraError, ConfigError, DeepshadeError
from deepshade.gbuffer import load_gbuffer
from deepshade.gbuffer.axes import EVERY, Axes
from deepshade.gbuffer.channels import parse_mapping
from deepshade.gbuffer.conventions import parse_conventions
from deepshade.gbuffer.depths import KINDS, planar
from deepshade.gbuffer.directions import LONGEST, mend
from deepshade.gbuffer.profiles import PROFILES, QUANTITIES

quick = settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
# What an EXR header can hold: see `exr.encode`.
FLOATS = st.floats(width=32)
FACTS = st.one_of(
    FLOATS,
    st.integers(-(2**31), 2**31 - 1),
    st.text(st.characters(codec="ascii", categories=("L", "N", "P")), max_size=20),
    st.sampled_from([(2,), (3,), (3, 3), (4, 4)]).flatmap(
        lambda shape: st.lists(FLOATS, min_size=math.prod(shape), max_size=math.prod(shape)).map(
            lambda values: np.array(values, np.float32).reshape(shape)
        )
    ),
)
NAMES = [
    "deepshade:fov",
    "deepshade:radius",
    "deepshade:focus",
    "deepshade:aperture",
    "deepshade:shutter",
    "worldToCamera",
    "worldToNDC",
    "fieldOfViewHorizontal",
    "fov",
    "envmap",
    "screenWindowWidth",
    "screenWindowCenter",
    "pixelAspectRatio",
    "owner",
    "File",
    "unreal/camera/fov",
    "generated_by",
]
LAYERS = ["Z", "Y", "A", "N.X", "N.Y", "N.Z", "P.X", "P.Y", "P.Z", "position.X", "position.Y"]
LAYERS += ["position.Z", "normal.X", "normal.Y", "normal.Z", "Depth.V", "left.N.X", "R", "G", "B"]
WINDOW = (0, 0, 3, 2)


@given(facts=st.dictionaries(st.sampled_from(NAMES), FACTS))
@quick
def test_a_camera_is_usable_none_or_an_error_that_says_why(facts):
    try:
        camera = Camera.from_header(facts, WINDOW, WINDOW)
    except CameraError as error:
        assert str(error)
        return
    if camera is not None:
        assert 0 < camera.fov < 180
        assert np.isfinite(camera.rays()).all() or abs(camera.fov - 180) < 1e-3
    for name, value in placement_of(facts).items():
        assert np.isfinite(np.asarray(value)).all(), name


@given(
    turn=st.lists(st.floats(-10, 10), min_size=3, max_size=3),
    place=st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3),
    dress=st.sampled_from([str, np.ndarray.tolist, lambda m: " ".join(map(str, m.ravel()))]),
    rows=st.sampled_from([3, 4]),
)
@quick
def test_a_matrix_is_read_as_it_was_written(turn, place, dress, rows):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = place
    with np.printoptions(floatmode="unique"):
        text = str(dress(matrix[:rows])).replace("array", "")
    np.testing.assert_array_equal(parse_matrix(text), matrix)


@given(text=st.text(st.sampled_from("0123456789.,;()[]eE+-naif \n"), max_size=80))
@quick
def test_no_text_is_half_a_matrix(text):
    try:
        matrix = parse_matrix(text)
    except CameraError as error:
        assert str(error)
    else:
        assert matrix.shape == (4, 4) and np.isfinite(matrix).all()


@given(text=st.text(max_size=30))
@quick
def test_mappings_and_axes_are_read_or_refused(text):
    for read in (lambda: parse_mapping([text]), lambda: parse_conventions([text], None, None)):
        try:
            read()
        except ConfigError as error:
            assert str(error)
    try:
        name, equals, target = text.partition("=")
        assert parse_mapping([text]) == {name.strip(): target.strip()} and equals
    except ConfigError:
        assert not (name.strip() and equals and target.strip())


@pytest.mark.parametrize("axes", EVERY, ids=str)
def test_axes_go_through_text_and_keep_lengths(axes):
    assert Axes.parse(str(axes)) == axes
    matrix = axes.of(np.eye(3))
    np.testing.assert_array_equal(matrix @ matrix.T, np.eye(3))


@given(
    depth=st.floats(1e-2, 1e4),
    near=st.floats(1e-3, 5e-3),
    far=st.floats(2e4, 1e6),
    kind=st.sampled_from(KINDS),
)
@quick
def test_every_kind_of_depth_is_undone(depth, near, far, kind):
    """By what the kinds mean, in float64: a projection's depth is linear in 1 / depth."""
    share = (1 / near - 1 / depth) / (1 / near - 1 / far)
    stored = {
        "planar": depth,
        "distance": depth * 1.25,
        "inverse": 1 / depth,
        "normalised": (depth - near) / (far - near),
        "zbuffer": share,
        "reversed": 1 - share,
    }[kind]
    slant = np.array([1.25])
    found = planar(np.array([stored]), kind, slant=slant, near=near, far=far)[0]
    assert found == pytest.approx(depth, rel=2e-4 if kind == "reversed" else 1e-5, abs=1e-6)


@given(values=st.lists(FLOATS, min_size=12, max_size=12))
@quick
def test_directions_are_mended_and_otherwise_left(values):
    before = np.array(values, np.float32).reshape(3, 2, 2)
    after = before.copy()
    mend({"normal": after, "depth": before[:1].copy()})
    wide = before.astype(np.float64)
    length = np.sqrt((wide * wide).sum(0))
    for place in np.ndindex(2, 2):
        was, now = wide[:, *place], after[:, *place]
        if not np.isfinite(was).all() or 1e-15 < length[place] < LONGEST * 0.999:
            np.testing.assert_array_equal(now, before[:, *place])
        elif length[place] > LONGEST * 1.001:
            np.testing.assert_allclose(now, was / length[place], rtol=1e-5, atol=1e-7)
        elif length[place] < 1e-24:
            assert not now.any()


@given(
    channels=st.sets(st.sampled_from(LAYERS), min_size=1),
    facts=st.dictionaries(st.sampled_from(NAMES), FACTS, max_size=5),
    mapping=st.dictionaries(
        st.sampled_from([*QUANTITIES, "norml", ""]),
        st.sampled_from([*LAYERS, "N", "x", "N.X,N.Y"]),
        max_size=2,
    ),
    profile=st.sampled_from([None, *PROFILES]),
    needs=st.sets(st.sampled_from(["normal", "position", "depth", "focal", "view"]), min_size=1),
    value=st.sampled_from([0.0, 1.0, -2.0, math.nan, math.inf, 65504.0, 1e-40]),
)
@quick
def test_a_gbuffer_is_usable_or_refused(channels, facts, mapping, profile, needs, value):
    planes = {name: np.full((3, 4), value, np.float32) for name in channels}
    body = io.BytesIO()
    try:
        exr.write(body, planes, attributes=facts)
    except (ValueError, struct.error, OverflowError):
        return  # no file can hold it
    try:
        gbuffer = load_gbuffer(body.getvalue(), sorted(needs), profile=profile, mapping=mapping)
    except DeepshadeError as error:
        assert str(error)
        return
    assert set(gbuffer.attributes) == needs
    assert all(np.isfinite(plane).all() for plane in gbuffer.attributes.values())
