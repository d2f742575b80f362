"""Half floats to float32 and back, against numpy's own conversion of every value there is."""

import numpy as np
import pytest

from deepshade import floats

EVERY = np.arange(2**16, dtype=np.uint16).view(np.float16)
FINITE = EVERY[np.isfinite(EVERY)]


def test_every_half_becomes_the_same_float():
    out = np.empty(FINITE.shape, np.float32)
    assert floats.to_float(FINITE, out)
    np.testing.assert_array_equal(out.view(np.uint32), FINITE.astype(np.float32).view(np.uint32))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_told_and_kept(bad):
    halves = np.append(FINITE, np.float16(bad))
    if np.isnan(bad):
        halves = np.append(halves, -np.float16(bad))
    out = np.empty(halves.shape, np.float32)
    assert not floats.to_float(halves, out)
    np.testing.assert_array_equal(out, halves.astype(np.float32))
    assert not floats.is_finite(out)
    assert floats.is_finite(out[: FINITE.size])


def test_floats_round_to_the_nearest_even_half():
    # every half, the ties between neighbours, and what lies just beside those
    values = np.unique(FINITE.astype(np.float32))
    ties = (values[1:] + values[:-1]) / 2
    beside = [np.nextafter(ties, np.float32(side)) for side in (-np.inf, np.inf)]
    for chosen in (values, ties, *beside):
        for part in (chosen, chosen[chosen >= 2**-14], chosen[:0]):
            np.testing.assert_array_equal(
                floats.to_half(part).view(np.uint16) if part.size else part,
                part.astype(np.float16).view(np.uint16) if part.size else part,
            )


def test_what_no_half_holds_is_clamped():
    values = np.array([1e9, 65519.0, 65520.0, -1e30, np.inf, -np.inf, np.nan, 1e-30], np.float32)
    expected = [65504, 65504, 65504, -65504, np.inf, -np.inf, np.nan, 0]
    np.testing.assert_array_equal(floats.to_half(values), expected)
    np.testing.assert_array_equal(floats.to_half(values[:3] + np.float32(1)), expected[:3])


def test_strided_and_other_types_convert_too():
    values = np.arange(1, 25).reshape(4, 6)[:, ::2]
    np.testing.assert_array_equal(floats.to_half(values), values)
    assert floats.to_half(values.astype(np.float64).T).flags.c_contiguous
