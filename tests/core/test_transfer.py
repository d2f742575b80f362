"""Transfer functions: there and back, in both array libraries."""

import numpy as np
import pytest

from deepshade import transfer


@pytest.mark.parametrize("curve", ["linear", "log"])
def test_there_and_back(curve):
    light = np.array([0, 1e-6, 1e-3, 0.5, 1, 70_000, 1e5, 1e30], np.float32)
    there = transfer.forward(light, curve, np)
    assert there.dtype == np.float32
    assert np.allclose(transfer.inverse(there, curve, np), light, rtol=2e-5)


def test_nothing_becomes_infinite_or_not_a_number():
    y = np.array([-1e9, -1, 0, 88, 1e9], np.float32)
    assert np.isfinite(transfer.inverse(y, "log", np)).all()
    assert np.isfinite(transfer.forward(np.array([-5.0, 3e38], np.float32), "log", np)).all()
