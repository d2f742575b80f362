"""G-buffers in every renderer's manner: each must give the same camera-space attributes."""

import io

import numpy as np
import OpenEXR
import pytest

from deepshade import exr
from deepshade.camera import Camera
from deepshade.errors import (
    AmbiguousChannelError,
    CameraError,
    ConfigError,
    DamagedImageError,
    ImageError,
    LimitError,
    MissingAttributeError,
)
from deepshade.exr import Limits
from deepshade.gbuffer import load_gbuffer, load_gbuffers

NEEDS = ("normal", "position")
W, H = 48, 32
CAMERA = Camera.look_at((3, 2, 5), (0.2, 0.1, 0), (0, 1, 0), 50, W, H)
INVERSE = np.linalg.inv(CAMERA.matrix)
FLIP = np.diag([1.0, 1.0, -1.0, 1.0])


def floor_and_sky():
    """Camera-space positions and normals of the plane y = -1 in world space; (P, N, hit)."""
    rays = CAMERA.rays().astype(np.float64)
    turned = np.tensordot(INVERSE[:3, :3], rays, 1)
    t = np.where(turned[1] < -0.05, (-1 - CAMERA.eye[1]) / np.minimum(turned[1], -0.05), 0)
    hit = t > 0
    hit[:4] = False
    normal = CAMERA.matrix[:3, 1][:, None, None] * hit
    return (rays * t * hit).astype("f"), normal.astype("f"), hit


P, N, HIT = floor_and_sky()
Z = np.where(HIT, -P[2], np.inf).astype("f")
P_WORLD = ((np.tensordot(INVERSE[:3, :3], P, 1) + INVERSE[:3, 3][:, None, None]) * HIT).astype("f")
N_WORLD = (np.tensordot(INVERSE[:3, :3], N, 1)).astype("f")
HEADER = CAMERA.to_header()


def layer(name, planes, letters="XYZ"):
    return {f"{name}.{c}" if name else c: plane for c, plane in zip(letters, planes, strict=True)}


def encode(channels, attributes=HEADER, **settings):
    body = io.BytesIO()
    exr.write(body, channels, attributes=attributes, **settings)
    return body.getvalue()


def check(gbuffer, atol=1e-4):
    np.testing.assert_array_equal(gbuffer.background, ~HIT)
    np.testing.assert_allclose(gbuffer.attributes["position"], P, atol=atol, rtol=1e-4)
    cosine = (gbuffer.attributes["normal"] * N).sum(0)[HIT]
    np.testing.assert_allclose(cosine, 1, atol=1e-3)
    for array in gbuffer.attributes.values():
        assert array.dtype == np.float32
        assert array.flags.c_contiguous
        assert (array[:, ~HIT] == 0).all()


def test_canonical():
    gbuffer = load_gbuffer(encode(layer("normal", N) | layer("position", P)), NEEDS)
    check(gbuffer, atol=0)
    assert gbuffer.derived == {}
    assert gbuffer.mapped["normal"] == "normal.X, normal.Y, normal.Z"
    assert gbuffer.camera == CAMERA
    assert gbuffer.nonfinite == 0
    assert gbuffer.header["deepshade:fov"] == 50


@pytest.mark.parametrize("letters", ["XYZ", "RGB", "xyz", "rgb", ("red", "green", "blue")])
def test_suffixes(letters):
    body = encode(layer("normal", N, letters) | layer("position", P, letters))
    check(load_gbuffer(body, NEEDS))


RENDERERS = {
    "blender": (
        layer("ViewLayer.Position", P_WORLD)
        | layer("ViewLayer.Normal", N_WORLD)
        | {"ViewLayer.Depth.Z": Z},
        HEADER,
    ),
    "mitsuba": (
        layer("position", P_WORLD)
        | layer("sh_normal", N_WORLD)
        | {"dd.y.T": np.sqrt((P * P).sum(0))},
        HEADER | {"generatedBy": "Mitsuba version 3.9.1"},
    ),
    "arnold": (
        layer("P", P_WORLD) | layer("N", N_WORLD) | {"Z": Z},
        # Arnold's camera is left-handed
        {"arnold/version": "7", "worldToCamera": (FLIP @ CAMERA.matrix).T, "CameraFov": 50.0},
    ),
    "renderman": (
        layer("Pworld", P_WORLD) | layer("Nn", N * np.float32([[[1]], [[1]], [[-1]]])) | {"z": Z},
        HEADER | {"worldToCamera": (FLIP @ CAMERA.matrix).T},
    ),
    "vray": (layer("normals", N, "RGB") | {"zDepth": Z}, HEADER),
    "3delight": (
        layer("P.camera", P) | layer("N.camera", N) | {"z": Z},
        HEADER | {"Software": "3Delight 2.9"},
    ),
    "mantra": (
        layer("P", P) | layer("N", N) | {"Pz": Z},
        HEADER | {"Software": "mantra 20.5"},
    ),
    "karma": (
        layer("P", P_WORLD) | layer("N", N_WORLD) | {"Pz": Z},
        HEADER | {"renderTime_s": "0.34", "renderMemory_s": "683 MB"},
    ),
    "luxcore": (
        layer("POSITION", P_WORLD, "RGB")
        | layer("SHADING_NORMAL", N_WORLD, "RGB")
        | {"DEPTH.Y": np.sqrt((P * P).sum(0))},
        HEADER | {"Software": "LuxCoreRender 2.9"},
    ),
    "blenderproc": (  # encoded, and nothing is (0, 0, 0)
        layer("normals", np.where(HIT, N / 2 + 0.5, 0).astype("f"), "RGB") | {"depth.V": Z},
        HEADER | {"Software": "BlenderProc 2.7"},
    ),
    "replicator": (
        layer("normals", N_WORLD)
        | layer("PtWorldPos", P_WORLD)
        | {"distance_to_image_plane": Z, "distance_to_camera": np.sqrt((P * P).sum(0))},
        HEADER | {"Software": "Omniverse Replicator"},
    ),
}


@pytest.mark.parametrize("name", RENDERERS)
@pytest.mark.parametrize("named", [False, True])
def test_renderers(name, named):
    channels, header = RENDERERS[name]
    gbuffer = load_gbuffer(encode(channels, header), NEEDS, profile=name if named else None)
    check(gbuffer)
    assert set(gbuffer.derived) <= {"normal", "position"}


@pytest.mark.parametrize(
    "channels",
    [
        {"distance": np.sqrt((P * P).sum(0))},
        {"Pz": Z},
        layer("P_camera", P),
        {"depth.left.Z": Z},  # the only view
        {"Z.left.V": Z},
    ],
)
def test_what_people_call_them(channels):
    check(load_gbuffer(encode(channels | layer("N_camera", N)), NEEDS))


@pytest.mark.parametrize("letters", ["Y", "V", "L", "RGB"])
def test_a_grey_file_is_about_its_name(letters):
    depth = encode(dict.fromkeys(letters, Z))
    normal = encode(layer("", N, "RGB"))
    check(load_gbuffer([("shot_depth.0007.exr", depth), ("shot_normal.0007.exr", normal)], NEEDS))
    check(load_gbuffer([("depth.exr", depth), ("normal.exr", normal)], NEEDS))


def test_motion_of_a_whole_frame_s_interval():
    vector = dict(zip("XYZW", np.float32([5, 6, 7, 8])[:, None, None] + 0 * P[:1], strict=True))
    channels = {f"ViewLayer.Vector.{name}": plane for name, plane in vector.items()}
    gbuffer = load_gbuffer(encode(channels), ("motion",))
    assert gbuffer.attributes["motion"][:, 20, 20].tolist() == [7, -8]
    assert gbuffer.per_frame
    assert gbuffer.header["deepshade:shutter"] == 1
    said = load_gbuffer(encode(channels, HEADER | {"deepshade:shutter": 0.5}), ("motion",))
    assert not said.per_frame
    own = load_gbuffer(encode(layer("motion", P[:2], "UV")), ("motion",))
    assert not own.per_frame


def test_unreal_world_is_left_handed_centimetres():
    # a camera at (100, 200, 300) cm that looks along +x (yaw 0): right is +y, up is +z
    eye = np.array([100.0, 200, 300])
    world = np.stack([eye[0] - P[2], eye[1] + P[0], eye[2] + P[1]]) * HIT
    normals = np.stack([-N[2], N[0], N[1]])
    header = {f"unreal/camera/curPos/{c}": str(v) for c, v in zip("xyz", eye, strict=True)}
    header |= {f"unreal/camera/curRot/{c}": "0" for c in ("pitch", "yaw", "roll")}
    header |= {"unreal/camera/FinalImage/fov": "50"}
    channels = layer("FinalImageWorldPosition", world, "RGB")
    channels |= layer("FinalImageMovieRenderQueue_WorldNormal", normals, "RGB")
    channels |= layer("FinalImageMovieRenderQueue_WorldDepth", [Z, Z, Z], "RGB")
    gbuffer = load_gbuffer(encode(channels, header), NEEDS)
    check(gbuffer)
    assert gbuffer.camera is not None
    assert gbuffer.camera.fov == 50


def test_unreal_yaw_turns_clockwise():
    header = {f"unreal/camera/curPos/{c}": "0" for c in "xyz"}
    header |= {"unreal/camera/curRot/pitch": "0", "unreal/camera/curRot/yaw": "90"}
    header |= {"unreal/camera/curRot/roll": "0", "unreal/camera/FinalImage/fov": "50"}
    body = encode({"FinalImageWorldDepth.R": np.ones((4, 4))}, header)
    camera = load_gbuffer(body, ("position",)).camera
    # after a quarter turn the camera looks along +y, and +x is to its left
    np.testing.assert_allclose(camera.matrix @ (0, 7, 0, 1), [0, 0, -7, 1], atol=1e-6)
    np.testing.assert_allclose(camera.matrix @ (7, 0, 0, 1), [-7, 0, 0, 1], atol=1e-6)


def test_depth_alone_is_enough_with_a_field_of_view():
    gbuffer = load_gbuffer(encode({"Z": Z}, {}), NEEDS, fov=50)
    check(gbuffer)
    assert "depth" in gbuffer.derived["position"]
    assert "neighbouring" in gbuffer.derived["normal"]


def test_derived_world_attributes():
    body = encode({"Z": Z} | layer("normal", N))
    gbuffer = load_gbuffer(body, ("normal_world", "view", "view_angle", "depth"))
    np.testing.assert_allclose(gbuffer.attributes["normal_world"], N_WORLD, atol=1e-5)
    toward = CAMERA.eye[:, None, None] - P_WORLD
    toward /= np.linalg.norm(toward, axis=0)
    np.testing.assert_allclose(gbuffer.attributes["view"] * HIT, toward * HIT, atol=1e-5)
    # the sky too is seen from somewhere: against the camera's rays, turned to the world
    rays = np.einsum("ji,jhw->ihw", CAMERA.matrix[:3, :3], -CAMERA.rays())
    rays /= np.linalg.norm(rays, axis=0)
    np.testing.assert_allclose(gbuffer.attributes["view"], rays, atol=1e-5)
    angle = np.arccos(np.clip((toward * N_WORLD).sum(0), -1, 1)) * HIT
    np.testing.assert_allclose(gbuffer.attributes["view_angle"][0], angle, atol=1e-3)
    assert set(gbuffer.attributes) == {"normal_world", "view", "view_angle", "depth"}


def test_focal_from_the_header():
    body = encode({"Z": Z}, HEADER | {"deepshade:focus": 4.0, "deepshade:aperture": 0.2})
    focal = load_gbuffer(body, ("focal",)).attributes["focal"][0]
    depth = Z[HIT].astype(np.float64)
    expected = 0.2 * (depth - 4) / (depth * 4) * (W / 2) / np.tan(np.radians(25))
    np.testing.assert_allclose(focal[HIT], expected, rtol=1e-4, atol=1e-5)


def test_background_keeps_what_says_something_of_it():
    """The sky's light and the blur at infinity; not what NaN or a surface's attribute says."""
    light = np.full((3, H, W), 70_000, np.float32)
    light[:, ~HIT] = 0.25
    light[1, 0, 0] = np.nan
    assert not HIT[0, 0]
    header = HEADER | {"deepshade:focus": 4.0, "deepshade:aperture": 0.2}
    channels = {"Z": Z} | layer("light", light, "RGB") | layer("light_diffuse", light, "RGB")
    gbuffer = load_gbuffer(encode(channels, header), ("light", "light_diffuse", "focal", "depth"))
    found = gbuffer.attributes
    sky = ~HIT
    sky[0, 0] = False
    assert (found["light"][:, sky] == 0.25).all()
    assert (found["light"][:, 0, 0] == 0).all()
    assert (found["light"][:, HIT] == 70_000).all()
    assert not found["light_diffuse"][:, ~HIT].any()
    at_infinity = 0.2 / 4 * (W / 2) / np.tan(np.radians(25))
    np.testing.assert_allclose(found["focal"][0][~HIT], at_infinity, rtol=1e-4)


def test_one_file_for_each_attribute(tmp_path):
    for name, planes in {"normal": N, "position": P}.items():
        path = tmp_path / f"shot_{name}.exr"
        exr.write(path, layer("", planes, "RGB") | {"A": HIT.astype("f")}, attributes=HEADER)
    paths = sorted(tmp_path.glob("*.exr"))
    check(load_gbuffer(paths, NEEDS))
    check(load_gbuffer([(path.name, path.read_bytes()) for path in paths], NEEDS))


@pytest.mark.parametrize("prefixed", [True, False])
def test_parts_for_attributes(prefixed):
    parts = []
    for name, planes in {"normal": N, "position": P}.items():
        channels = layer(name if prefixed else "", planes)
        header = {"type": OpenEXR.scanlineimage}
        parts.append(OpenEXR.Part(header, {k: v.copy() for k, v in channels.items()}, name))
    body = io.BytesIO()
    OpenEXR.File(parts).write(body)
    check(load_gbuffer(body.getvalue(), NEEDS))


def test_a_cut_of_the_frame():
    cut = encode(
        {"Z": Z[5:25, 7:40]}, data_window=(7, 5, 39, 24), display_window=(0, 0, W - 1, H - 1)
    )
    position = load_gbuffer(cut, ("position",)).attributes["position"]
    np.testing.assert_allclose(position, P[:, 5:25, 7:40], rtol=1e-5, atol=1e-5)


def test_mapping_overrides():
    channels = layer("foo", N) | layer("position", P) | layer("normal", -N)
    check(load_gbuffer(encode(channels), NEEDS, mapping={"normal": "foo"}))
    parts = {"nx": N[0], "ny": N[1], "nz": N[2]} | layer("position", P)
    check(load_gbuffer(encode(parts), NEEDS, mapping={"normal": "nx,ny,nz"}))
    with pytest.raises(MissingAttributeError) as caught:
        load_gbuffer(encode(channels), NEEDS, mapping={"normal": "fooo"})
    assert caught.value.near["normal"][0] == "foo"
    with pytest.raises(ConfigError, match="nromal") as unknown:
        load_gbuffer(encode(channels), NEEDS, mapping={"nromal": "foo"})
    assert "normal" in unknown.value.fix


@pytest.mark.parametrize(
    "channels",
    [
        layer("A.normal", N) | layer("B.normal", N),
        layer("normal", N) | layer("normal", N, "RGB"),
        layer("normal", N) | layer("normal", N, "xyz"),
        layer("left.Normal", N_WORLD) | layer("right.Normal", N_WORLD),
        layer("NORMAL", N),  # camera space by our names, world space by Blender's
    ],
)
def test_ambiguity_is_never_resolved_by_a_guess(channels):
    with pytest.raises(AmbiguousChannelError) as caught:
        load_gbuffer(encode(channels | layer("position", P)), NEEDS)
    assert len(caught.value.candidates) >= 2


def test_object_space_is_world_space_only_where_nothing_was_moved():
    normal = {f"normal_world.{axis}": np.full((6, 6), 0.6 * (axis != "Z")) for axis in "XYZ"}
    normal = {name: plane.astype(np.float32) for name, plane in normal.items()}
    with pytest.raises(CameraError, match="never moved") as caught:
        load_gbuffer(encode(normal, {}), ["normal_object"])
    assert "deepshade:unmoved" in caught.value.fix
    found = load_gbuffer(
        encode(normal, {"deepshade:unmoved": "1"}), ["normal_object", "normal_world"]
    )
    assert (found.attributes["normal_object"] == found.attributes["normal_world"]).all()
    mapped = load_gbuffer(
        encode(normal, {}), ["normal_object"], mapping={"normal_object": "normal_world"}
    )
    assert (mapped.attributes["normal_object"] == found.attributes["normal_world"]).all()


def test_missing_attributes_name_near_misses():
    with pytest.raises(MissingAttributeError) as caught:
        load_gbuffer(encode(layer("nornal", N) | layer("RGB", N, "RGB")), NEEDS)
    assert caught.value.missing == ("normal", "position")
    assert caught.value.near["normal"][0] == "nornal"
    assert "RGB.R" in caught.value.found


def test_what_the_camera_must_tell():
    with pytest.raises(CameraError, match="field of view") as caught:
        load_gbuffer(encode({"Z": Z}, {}), NEEDS)
    assert "fov" in caught.value.fix
    with pytest.raises(CameraError, match="worldToCamera"):
        load_gbuffer(encode(layer("P", P_WORLD), {}), NEEDS)


def test_world_normals_without_a_matrix_are_passed_over_aloud():
    gbuffer = load_gbuffer(encode(layer("N", N_WORLD) | {"Z": Z}, {}), NEEDS, fov=50)
    check(gbuffer)
    assert "worldToCamera" in gbuffer.derived["normal"]


def test_positions_behind_the_camera_are_read_with_the_axes_that_fit():
    gbuffer = load_gbuffer(encode(layer("normal", N) | layer("position", -P)), NEEDS)
    check(gbuffer)
    assert "-x,-y,-z" in gbuffer.derived["position"]


def test_non_finite_pixels_become_background_and_are_counted():
    normal, position = N.copy(), P.copy()
    normal[0, 10, 10] = np.nan
    position[1, 20, 20] = np.inf
    position[2, 20, 20] = -np.inf
    gbuffer = load_gbuffer(encode(layer("normal", normal) | layer("position", position)), NEEDS)
    assert gbuffer.nonfinite == 2
    assert gbuffer.background[10, 10]
    assert gbuffer.background[20, 20]
    assert gbuffer.background.sum() == (~HIT).sum() + 2
    for array in gbuffer.attributes.values():
        assert np.isfinite(array).all()
        assert (array[:, gbuffer.background] == 0).all()


@pytest.mark.parametrize("value", [0, -1, np.inf, 1e10, 3e38, np.nan])
def test_background_depths(value):
    depth = np.full((4, 4), 2.0, "f")
    depth[1, 2] = value
    gbuffer = load_gbuffer(encode({"Z": depth}), NEEDS)
    assert gbuffer.background.sum() == 1
    assert gbuffer.background[1, 2]
    assert gbuffer.nonfinite == int(np.isnan(value))
    assert np.isfinite(gbuffer.attributes["normal"]).all()


def test_background_by_alpha_and_zero_normal():
    alpha = np.ones((H, W), "f")
    alpha[HIT & (np.arange(W) == 20)] = 0
    normal = N.copy()
    normal[:, HIT & (np.arange(W) == 30)] = 0
    body = encode(layer("normal", normal) | layer("position", P) | {"A": alpha})
    gbuffer = load_gbuffer(body, NEEDS)
    np.testing.assert_array_equal(
        gbuffer.background, ~HIT | (np.arange(W) == 20) | (np.arange(W) == 30)
    )


def test_normals_that_interpolation_shortened_keep_their_length():
    gbuffer = load_gbuffer(encode(layer("normal", 0.93 * N) | layer("position", P)), NEEDS)
    np.testing.assert_array_equal(gbuffer.attributes["normal"], np.float32(0.93 * N))


def test_everything_background_and_one_pixel():
    gbuffer = load_gbuffer(encode({"Z": np.full((3, 3), np.inf)}), NEEDS)
    assert gbuffer.background.all()
    assert not gbuffer.attributes["normal"].any()
    one = load_gbuffer(encode({"Z": np.full((1, 1), 2.0)}), NEEDS)
    np.testing.assert_allclose(one.attributes["normal"][:, 0, 0], [0, 0, 1], atol=1e-6)


def test_files_must_cover_the_same_pixels():
    sources = [
        ("normal.exr", encode(layer("", N))),
        ("position.exr", encode(layer("", P[:, 1:]))),
    ]
    with pytest.raises(ImageError, match="different pixels"):
        load_gbuffer(sources, NEEDS)
    shifted = [sources[0], ("position.exr", encode(layer("", P), data_window=(1, 0, W, H - 1)))]
    with pytest.raises(ImageError, match="different pixels"):
        load_gbuffer(shifted, NEEDS)


def parted(*parts):
    """A multi-part EXR of (name, channels, x0, y0), written by OpenEXR itself."""
    made = []
    for name, planes, x0, y0 in parts:
        height, width = next(iter(planes.values())).shape
        made.append(
            OpenEXR.Part(
                {
                    "type": OpenEXR.scanlineimage,
                    "compression": OpenEXR.ZIP_COMPRESSION,
                    "dataWindow": (
                        np.int32([x0, y0]),
                        np.int32([x0 + width - 1, y0 + height - 1]),
                    ),
                    "displayWindow": (np.int32([0, 0]), np.int32([W - 1, H - 1])),
                },
                {key: np.ascontiguousarray(plane) for key, plane in planes.items()},
                name,
            )
        )
    body = io.BytesIO()
    with OpenEXR.File(made) as file:
        file.write(body)
    return body.getvalue()


def test_markers_of_other_pixels_are_passed_over():
    """An auto-cropped RGBA part says nothing about the pixels of the data part."""
    small = dict.fromkeys("RGBA", np.zeros((8, 8), "f"))
    data = layer("normal", N) | layer("position", P)
    body = parted(("beauty", small, 5, 6), ("data", data, 0, 0))
    gbuffer = load_gbuffer(body, NEEDS)
    check(gbuffer, atol=0)
    assert "alpha" not in gbuffer.mapped
    assert gbuffer.data_window == (0, 0, W - 1, H - 1)
    with pytest.raises(ImageError, match="cover different pixels"):
        load_gbuffer(body, NEEDS, mapping={"alpha": "A"})


def test_windows_and_camera_are_those_of_the_data():
    small = {"A": np.ones((8, 8), "f")}
    crop = {name: plane[4:20, 8:40] for name, plane in layer("normal", N).items()}
    crop["Z"] = Z[4:20, 8:40]
    body = parted(("beauty", small, 5, 6), ("data", crop, 8, 4))
    gbuffer = load_gbuffer(body, NEEDS, fov=50)
    assert gbuffer.data_window == (8, 4, 39, 19)
    assert gbuffer.display_window == (0, 0, W - 1, H - 1)
    np.testing.assert_allclose(gbuffer.attributes["position"], P[:, 4:20, 8:40], atol=1e-4)


def test_attributes_that_share_channels_keep_their_own_signs():
    """RenderMan's Nn has z into the screen; the same channels as colours have no such sign."""
    stored = N * np.float32([[[1]], [[1]], [[-1]]])
    body = encode(layer("Nn", stored) | layer("position", P))
    both = load_gbuffer(
        body, ("normal", "light"), profile="renderman", mapping={"normal": "Nn", "light": "Nn"}
    )
    np.testing.assert_allclose(both.attributes["normal"], N, atol=1e-6)
    np.testing.assert_allclose(both.attributes["light"], stored, atol=1e-6)


def test_pixels_need_not_be_square():
    """Squeezed to half its width, a picture gives the positions of every second column."""
    aspect = encode(
        {"Z": Z[:, ::2], **layer("normal", N[:, :, ::2])},
        {"deepshade:fov": 50.0, "pixelAspectRatio": 2.0},
    )
    gbuffer = load_gbuffer(aspect, NEEDS)
    rays = Camera(50, W, H).rays()
    expected = (rays[:, :, ::2] + rays[:, :, 1::2]) / 2 * np.where(HIT, Z, 0)[:, ::2]
    np.testing.assert_allclose(gbuffer.attributes["position"], expected, atol=1e-4)
    assert gbuffer.camera.to_header()["pixelAspectRatio"] == 2


def test_world_positions_take_little_memory():
    import tracemalloc

    from deepshade.gbuffer import derivation

    points = np.ones((3, 512, 1024), "f")
    source = derivation.Source({"position_world": points}, points[0] > 0, matrix=CAMERA.matrix)
    (step,) = (s for s in derivation.steps_to("position") if s.needs == ("position_world",))
    tracemalloc.start()
    step.function(source)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 25 * 512 * 1024  # 12 bytes a pixel are the answer


def test_hints_compare_a_bounded_part_of_very_many_very_long_names(monkeypatch):
    from deepshade.gbuffer import suggestions

    compared = []
    closeness = suggestions._closeness
    monkeypatch.setattr(
        suggestions,
        "_closeness",
        lambda piece, *more: compared.append(piece) or closeness(piece, *more),
    )
    rng = np.random.default_rng(0)
    letters = np.array(list("positnrmal_."))
    names = ["".join(rng.choice(letters, 245)) + f"x{n}" for n in range(1000)]
    body = encode({**{name: np.ones((1, 1), "f") for name in names}, "positon.Q": np.ones((1, 1))})
    with pytest.raises(MissingAttributeError):
        load_gbuffer(body, NEEDS)
    assert 100 < len(compared) <= 1024
    assert max(map(len, compared)) <= 64


def test_limits_count_all_files_together():
    body = encode({"Z": Z})
    with pytest.raises(LimitError):
        load_gbuffer([body, body], ("depth",), limits=Limits(decoded_bytes=Z.nbytes * 2 - 1))
    with pytest.raises(LimitError):
        load_gbuffer([body, body], ("depth",), limits=Limits(body_bytes=len(body) * 2 - 1))


def test_unknown_names_and_no_files():
    with pytest.raises(ConfigError, match="nrml"):
        load_gbuffer(encode({"Z": Z}), ("nrml",))
    with pytest.raises(ConfigError, match="bledner") as caught:
        load_gbuffer(encode({"Z": Z}), NEEDS, profile="bledner")
    assert "blender" in caught.value.fix
    with pytest.raises(ImageError):
        load_gbuffer([], NEEDS)
    with pytest.raises(DamagedImageError):
        load_gbuffer(encode({"Z": Z})[:-5], NEEDS)


@pytest.mark.parametrize("factor", [1e-3, 1e4])
def test_scale_changes_nothing_but_the_scale(factor):
    base = load_gbuffer(encode({"Z": Z}), NEEDS)
    scaled = load_gbuffer(encode({"Z": Z * np.float32(factor)}), NEEDS)
    np.testing.assert_array_equal(base.background, scaled.background)
    np.testing.assert_allclose(
        scaled.attributes["position"], base.attributes["position"] * factor, rtol=1e-5
    )
    np.testing.assert_allclose(scaled.attributes["normal"], base.attributes["normal"], atol=1e-3)


WANTED = (("normal", "position"), ("focal",), ("light",), ("normal_world", "view"), ("depth",))
LIGHT = layer("light", np.full((3, H, W), 2, "f"), "RGB")


def broken(channels, name, value):
    """The channels, and in one of them a value amidst the floor."""
    plane = channels[name].copy()
    plane[20, 10] = value
    return channels | {name: plane}


FAR = layer("position_world", P_WORLD) | {"Z": Z}


@pytest.mark.parametrize(
    ("channels", "shared"),
    [
        ({"Z": Z}, True),
        (layer("position", P) | {"Z": Z}, True),
        (layer("position", P) | layer("normal", N), False),  # nothing marks the light's background
        (broken(layer("normal", N) | {"Z": Z}, "normal.Y", np.nan), False),
        (broken({"Z": Z}, "Z", np.nan), True),
        (broken(broken(FAR, "position_world.X", 3e38), "position_world.Z", -3e38), False),
    ],
    ids=["derived", "stored", "no depth", "NaN in one", "NaN in all", "overflows in one"],
)
def test_several_are_each_what_it_is_alone(channels, shared):
    """Bit for bit; and they share memory where they can."""
    header = HEADER | {"deepshade:focus": 4.0, "deepshade:aperture": 0.1}
    body = encode(channels | LIGHT, header, half=False)
    several = list(load_gbuffers(body, WANTED))
    for found, needs in zip(several, WANTED, strict=True):
        alone = load_gbuffer(body, needs)
        assert list(found.attributes) == list(needs)
        for name, array in alone.attributes.items():
            np.testing.assert_array_equal(found.attributes[name], array)
        np.testing.assert_array_equal(found.background, alone.background)
        for fact in ("nonfinite", "mapped", "decoded", "derived", "camera", "data_window"):
            assert getattr(found, fact) == getattr(alone, fact), fact
    assert (len({id(each.background) for each in several}) == 1) == shared


def test_several_must_cover_the_same_pixels():
    small = {f"light.{c}": np.ones((4, 4), "f") for c in "RGB"}
    bodies = [encode({"Z": Z}), encode(small, data_window=(0, 0, 3, 3))]
    assert load_gbuffer(bodies, ("depth",)).shape == (H, W)
    with pytest.raises(ImageError, match="different pixels"):
        list(load_gbuffers(bodies, [("depth",), ("light",)]))


def test_all_that_several_lack_is_said_at_once():
    with pytest.raises(MissingAttributeError) as caught:
        list(load_gbuffers(encode({"Z": Z}), [("depth",), ("light",), ("motion", "scatter")]))
    assert caught.value.missing == ("light", "motion", "scatter")
