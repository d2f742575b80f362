"""The generated sky: where its sun stands, how much it gives, and against Mitsuba's."""

import numpy as np
import pytest

from deepshade.environments import directions, sky, solid_angles
from deepshade.errors import ConfigError
from deepshade_workers import backend


@pytest.mark.parametrize(("elevation", "azimuth"), [(35, 40), (10, 179.9), (89, -120), (2, 0)])
def test_the_sun_stands_where_it_was_put(elevation, azimuth):
    made = sky(elevation=elevation, azimuth=azimuth, height=128)
    weights = made.radiance.sum(0) * (made.radiance.sum(0) > 0.5 * made.radiance.sum(0).max())
    found = (directions(128, 256) * weights * solid_angles(128, 256)[:, None]).sum((1, 2))
    at, around = np.radians([elevation, azimuth])
    sun = np.sin(around) * np.cos(at), np.sin(at), -np.cos(around) * np.cos(at)
    cosine = found @ sun / np.linalg.norm(found)
    assert np.degrees(np.arccos(min(1, cosine))) < 1.5  # about a pixel


def test_white_ground_would_be_at_one_whatever_the_size():
    for height in (33, 64, 200):
        made = sky(height=height, elevation=50)
        cosine = directions(height, 2 * height)[1].clip(0)
        floor = (made.radiance * cosine * solid_angles(height, 2 * height)[:, None]).sum((1, 2))
        assert floor.mean() / np.pi == pytest.approx(1, rel=1e-3)
        below = made.radiance[:, -1, 0] / 0.2
        np.testing.assert_allclose(below, floor / np.pi, rtol=1e-3)


def test_a_low_sun_is_red_and_a_high_one_much_brighter_than_the_sky():
    low, high = (sky(elevation=angle, height=128).radiance for angle in (4, 60))
    suns = [map.reshape(3, -1)[:, map.sum(0).argmax()] for map in (low, high)]
    assert suns[0][0] / suns[0][2] > 3 * suns[1][0] / suns[1][2]
    assert high.max() > 1000 * np.median(high[:, :60])
    zenith = high[:, 0].mean(1)
    assert zenith[2] > 1.5 * zenith[0]


@pytest.mark.parametrize(("elevation", "turbidity"), [(60, 2.5), (35, 3)])
def test_the_sky_goes_with_mitsubas(elevation, turbidity):
    """Theirs is another model (Hosek and Wilkie's), so only what both must have is asked."""
    mitsuba = backend.mitsuba()
    made = sky(elevation=elevation, azimuth=0, turbidity=turbidity, height=32)
    angle = np.radians(elevation)
    towards = [0.0, -float(np.cos(angle)), float(np.sin(angle))]  # theirs is z up
    theirs = mitsuba.load_dict(
        {"type": "sunsky", "turbidity": turbidity, "sun_direction": towards, "sun_scale": 0.0}
    )
    x, y, z = directions(32, 64)[:, :15].reshape(3, -1)
    hit = mitsuba.SurfaceInteraction3f()
    hit.wi = -mitsuba.Vector3f(np.stack([x, z, y]))
    luminance = np.array([0.2126, 0.7152, 0.0722])
    a = np.log(luminance @ np.array(theirs.eval(hit)))
    b = np.log(luminance @ made.radiance[:, :15].reshape(3, -1))
    around = b < np.quantile(b, 0.97)  # not the sun
    assert np.corrcoef(a[around], b[around])[0, 1] > 0.6


@pytest.mark.parametrize("wrong", [{"elevation": 0}, {"turbidity": 1}, {"ground": 1.5}])
def test_what_the_model_does_not_know(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        sky(**wrong)
