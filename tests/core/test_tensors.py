"""Tensors from attributes: order, scale, one colour channel, boxes and padding."""

import numpy as np
import pytest

from deepshade import tensors
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS

GOES_ON = {"focal", "view", "light", "normal_world", "diffuse", "specular", "gloss"}


def attributes(names, height=6, width=10):
    rng = np.random.default_rng(5)
    return {
        name: rng.uniform(1, 9, (len(ATTRIBUTES[name].channels), height, width)).astype(np.float32)
        for name in names
    }


@pytest.mark.parametrize("name", EFFECTS)
def test_a_tensor_is_the_scaled_stack(name):
    effect = EFFECTS[name]
    given = attributes((*effect.inputs, "depth"))
    made = tensors.tensor(effect, given, effect.inputs, 2.5, per_channel=False, multiple=4)
    by = 2.5 if effect.lengths == "radius" else float(np.median(given["depth"][0, ::8, ::8]))
    expected = np.concatenate(
        [given[i] / (by if ATTRIBUTES[i].unit.scaled else 1) for i in effect.inputs]
    )
    assert made.shape == (1, tensors.channel_count(effect.inputs, False), 8, 12)
    assert np.allclose(made[0, :, :6, :10], expected, rtol=1e-6)
    # past the picture light and materials go on, and no geometry is there
    for attribute, place in tensors.channel_slices(effect.inputs, False).items():
        inner, below, right = made[0, place, :6, :10], made[0, place, 6:], made[0, place, :6, 10:]
        if attribute in GOES_ON:
            assert (below[..., :10] == inner[:, 5:]).all()
            assert (right == inner[..., 9:]).all()
            assert (below[..., 10:] == inner[:, 5:, 9:]).all()
        else:
            assert not below.any()
            assert not right.any()


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.per_channel])
def test_a_run_for_each_colour_channel(name):
    effect = EFFECTS[name]
    given = attributes(effect.inputs)
    three = tensors.tensor(effect, given, effect.inputs, 1.0, per_channel=True)
    assert three.shape[:2] == (3, tensors.channel_count(effect.inputs, True))
    places = tensors.channel_slices(effect.inputs, True)
    for attribute, place in places.items():
        block = three[:, place]
        if ATTRIBUTES[attribute].coloured:
            assert block.shape[1] == 1
            assert len({block[k].tobytes() for k in range(3)}) == 3
        else:
            assert (block == block[:1]).all()


def test_what_lies_together_is_not_copied():
    block = np.ones((6, 8, 8), np.float32)
    given = {"normal": block[:3], "position": block[3:]}
    channels = tensors.planes(given, ("normal", "position"), 1.0)
    assert tensors.cut(channels, (0, 8, 0, 8)).base is block
    assert tensors.cut(channels, (0, 4, 0, 8)).base is not block
    turned = tensors.planes(given, ("position", "normal"), 1.0)
    assert not np.shares_memory(tensors.cut(turned, (0, 8, 0, 8)), block)


def test_huge_lengths_stay_finite():
    given = {"normal": np.zeros((3, 2, 2), np.float32), "position": np.zeros((3, 2, 2), np.float32)}
    given["position"][2] = -3e38
    made = tensors.tensor(EFFECTS["ao"], given, ("normal", "position"), 1e-30, per_channel=False)
    assert made.min() == -tensors.MAX_LENGTH


def test_the_depth_scale_makes_units_meaningless():
    effect = EFFECTS["sss"]
    given = attributes(effect.inputs)
    given["position"][2] *= -1
    given["position"][:, 0, 0] = 0  # background
    inputs = effect.inputs
    metres = tensors.tensor(effect, given, inputs, 1.0, per_channel=False)
    for name in ("position", "scatter"):
        given[name] = given[name] * np.float32(1000)
    assert np.allclose(tensors.tensor(effect, given, inputs, 1.0, per_channel=False), metres)
    nothing = {name: np.zeros_like(a) for name, a in given.items()}
    assert tensors.length_scale(effect, nothing, 1.0) == 1.0
