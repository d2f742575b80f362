"""Environment maps: orientation, sampling, means, and files that are none."""

import math
from contextlib import suppress

import numpy as np
import pytest

from deepshade import exr
from deepshade.environments import (
    Environment,
    directions,
    read_environment,
    solid_angles,
    world_to_map,
)
from deepshade.errors import DamagedImageError, EnvironmentMapError, ImageError, LimitError
from deepshade_workers import backend

RANDOM = np.random.default_rng(11)


def noise(height=16):
    return Environment("noise", RANDOM.gamma(0.5, size=(3, height, 2 * height)))


def rgbe(radiance):
    """The bytes of a plain (not run-length encoded) HDR picture."""
    exponents = np.frexp(radiance.max(0))[1]
    mantissas = np.floor(radiance * np.exp2(8.0 - exponents)).astype(np.uint8)
    pixels = np.concatenate([mantissas, (exponents + 128).astype(np.uint8)[None]])
    height, width = radiance.shape[1:]
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    return head + pixels.transpose(1, 2, 0).tobytes(), mantissas * np.exp2(exponents - 8.0)


def test_directions_are_as_the_design_says():
    grid = directions(64, 128)
    np.testing.assert_allclose(np.linalg.norm(grid, axis=0), 1)
    np.testing.assert_allclose(grid[:, 31:33, 63:65].mean((1, 2)), [0, 0, -1], atol=1e-3)
    np.testing.assert_allclose(grid[:, 0, 0], [0, 1, 0], atol=0.03)  # row 0 is up
    assert grid[0, 32, 70] > 0.1  # to the right of the centre lies +x
    np.testing.assert_allclose(grid[:, 32, 96], [1, 0, 0], atol=0.03)


def test_solid_angles_cover_the_sphere():
    for height in (1, 2, 7, 512):
        assert solid_angles(height, 2 * height).sum() * 2 * height == pytest.approx(4 * math.pi)
    # the integral of each direction's square is a third of the sphere
    weights = solid_angles(256, 512)[:, None]
    moments = (directions(256, 512) ** 2 * weights).sum((1, 2))
    np.testing.assert_allclose(moments, 4 * math.pi / 3, rtol=1e-4)


def test_the_mean_is_by_solid_angle():
    cosine = directions(256, 512)[1].clip(0)  # its mean over the sphere is 1/4
    environment = Environment("", np.stack([cosine, 2 * cosine, np.ones_like(cosine)]))
    np.testing.assert_allclose(environment.mean, [0.25, 0.5, 1], rtol=1e-4)


def test_samples_are_the_pixels_at_their_centres():
    environment = noise()
    found = environment.sample(directions(*environment.shape))
    np.testing.assert_allclose(found, environment.radiance, rtol=1e-4, atol=1e-6)


def test_samples_are_bilinear_and_go_round():
    environment = noise()
    height, width = environment.shape
    for column in (3, width - 1):  # between the last and the first too
        phi = 2 * math.pi * ((column + 1) / width - 0.5)
        theta = math.pi * 6 / height  # between rows 5 and 6
        at = np.array(
            [math.sin(phi) * math.sin(theta), math.cos(theta), -math.cos(phi) * math.sin(theta)]
        )
        corners = environment.radiance[:, 5:7][:, :, [column, (column + 1) % width]]
        np.testing.assert_allclose(environment.sample(at), corners.mean((1, 2)), rtol=1e-5)


def test_rotation_by_columns_rolls_the_picture():
    environment = noise()
    # counter-clockwise from above: what was to the north comes to the west, left of the centre
    turned = environment.rotated(90)
    np.testing.assert_allclose(turned.radiance, np.roll(environment.radiance, -8, 2), atol=1e-5)
    np.testing.assert_allclose(world_to_map(90) @ [-1, 0, 0], [0, 0, -1], atol=1e-12)


def test_a_world_that_is_z_up():
    turn = world_to_map(0, "z")
    np.testing.assert_allclose(turn @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turn @ [0, 1, 0], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(turn @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    assert np.linalg.det(world_to_map(33, "z")) == pytest.approx(1)
    # about the world's own axis: east turns to the north
    np.testing.assert_allclose(world_to_map(90, "z") @ [0, 1, 0], [1, 0, 0], atol=1e-12)


def test_hdr_files_as_mitsuba_reads_them(tmp_path):
    bitmap = backend.mitsuba().Bitmap
    smooth = np.repeat(RANDOM.gamma(0.5, size=(3, 16, 8)), 4, axis=2).astype(np.float32)
    smooth[:, 3, 5] = 0
    path = tmp_path / "map.hdr"
    bitmap(np.ascontiguousarray(smooth.transpose(1, 2, 0))).write(str(path))
    theirs = np.array(bitmap(str(path))).transpose(2, 0, 1)
    ours = read_environment(path)
    assert ours.name == "map"
    np.testing.assert_array_equal(ours.radiance, theirs)
    np.testing.assert_allclose(ours.radiance, smooth, rtol=0.3, atol=smooth.max() / 256)


def test_plain_hdr_scanlines():
    data, values = rgbe(RANDOM.uniform(0.5, 2, size=(3, 4, 8)))
    np.testing.assert_allclose(read_environment(data).radiance, values, rtol=1e-6)
    exposed = data.replace(b"\n\n", b"\nEXPOSURE=2\nEXPOSURE=4\n\n", 1)
    np.testing.assert_allclose(read_environment(exposed).radiance, values / 8, rtol=1e-6)


def test_exr_files(tmp_path):
    environment = noise()
    layers = dict(zip("RGB", environment.radiance, strict=True))
    exr.write(tmp_path / "sky.exr", layers)
    found = read_environment(tmp_path / "sky.exr")
    np.testing.assert_array_equal(found.radiance, environment.radiance)
    assert (found.name, found.sha256) == ("sky", environment.sha256)
    exr.write(tmp_path / "layer.exr", {f"Image.{band}": plane for band, plane in layers.items()})
    assert read_environment(tmp_path / "layer.exr").sha256 == environment.sha256
    exr.write(tmp_path / "grey.exr", {"Y": environment.radiance[0]})
    np.testing.assert_array_equal(
        read_environment(tmp_path / "grey.exr").radiance, environment.radiance[[0, 0, 0]]
    )
    exr.write(tmp_path / "none.exr", {"Z": environment.radiance[0]})
    with pytest.raises(EnvironmentMapError, match="Z"):
        read_environment(tmp_path / "none.exr")


def test_the_hash_is_of_the_values():
    one, other = noise(), noise()
    assert one.sha256 != other.sha256
    assert Environment("renamed", one.radiance.copy()).sha256 == one.sha256


@pytest.mark.parametrize(
    ("value", "said"), [(-1, "-1"), (math.nan, "nan"), (math.inf, "inf"), (1e20, "1e.20")]
)
def test_values_that_no_light_has(value, said):
    radiance = np.ones((3, 4, 8), np.float32)
    radiance[1, 2, 5] = value
    with pytest.raises(EnvironmentMapError, match=f"'sky' holds {said} at row 2, column 5"):
        Environment("sky", radiance)


@pytest.mark.parametrize("shape", [(3, 4, 4), (1, 4, 8), (3, 0, 0), (4, 8)])
def test_shapes_that_are_no_map(shape):
    with pytest.raises(EnvironmentMapError, match=r"pixels|shape"):
        Environment("", np.ones(shape, np.float32))


def test_damaged_files():
    data, _ = rgbe(RANDOM.uniform(0.5, 2, size=(3, 4, 8)))
    for short in (data[:-1], data[:90]):
        with pytest.raises(DamagedImageError, match="scanline"):
            read_environment(short)
    with pytest.raises(ImageError, match="neither"):
        read_environment(b"P6 some picture")
    with pytest.raises(ImageError, match="size line"):
        read_environment(data.replace(b"-Y 4", b"+Y 4"))
    with pytest.raises(ImageError, match="xyze"):
        read_environment(data.replace(b"rle_rgbe", b"rle_xyze"))
    with pytest.raises(LimitError, match="pixels"):
        read_environment(data.replace(b"-Y 4 +X 8", b"-Y 99999 +X 199998"))


def test_damaged_run_lengths():
    width = 16
    head = f"#?RADIANCE\n\n-Y 8 +X {width}\n".encode()
    run = bytes([2, 2, 0, width]) + bytes([128 + width, 7]) * 4
    good = read_environment(head + run * 8)
    assert np.unique(good.radiance).size == 1
    for broken in (
        run.replace(bytes([128 + width]), bytes([129 + width])),  # past the scanline's end
        run.replace(bytes([128 + width]), b"\0"),  # no progress
        run[:-1],
    ):
        with pytest.raises(DamagedImageError):
            read_environment(head + broken * 7 + broken[:6])


def test_any_bytes_are_read_or_refused():
    """Whatever is behind a valid beginning: a map, or one of our errors."""
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n"
    for seed in range(200):
        draw = np.random.default_rng(seed)
        body = draw.integers(0, 256, draw.integers(0, 400), np.uint8)
        body[: 4 * (body.size // 4)].reshape(-1, 4)[::3, :] = (2, 2, 0, 8)
        with suppress(ImageError, EnvironmentMapError):
            assert read_environment(head + body.tobytes()).shape == (4, 8)
