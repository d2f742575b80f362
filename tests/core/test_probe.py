"""A bundle's probe: what is written is read again, and measured like any picture."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from deepshade import metrics, probe
from deepshade.bundles import PROBE, Bundle
from deepshade.errors import BundleError


def windows(effect_inputs=6, outputs=1, side=16, count=3):
    rng = np.random.default_rng(0)
    return [
        (
            rng.normal(scale=30, size=(effect_inputs, side, side)).astype(np.float32),
            rng.uniform(size=(outputs, side, side)).astype(np.float32),
        )
        for _ in range(count)
    ]


def bundle(folder, effect="ao", inputs=("normal", "position"), multiple=8):
    return Bundle(
        folder, effect, "b", inputs, ("Y",), 1.0, 50.0, multiple, 8, hashes={PROBE: "0" * 64}
    )


@pytest.mark.parametrize(
    ("effect", "inputs", "outputs"),
    [("ao", 6, 1), ("do", 9, 3), ("gi", 7, 1)],  # gi shades one colour channel at a time
)
def test_windows_come_back(tmp_path, effect, inputs, outputs):
    written = windows(inputs, outputs)
    probe.write_probe(tmp_path / PROBE, effect, written)
    read = probe.read_probe(bundle(tmp_path, effect))
    assert len(read) == len(written)
    for (gbuffer, reference), (g, r) in zip(written, read, strict=True):
        assert np.allclose(g, gbuffer, rtol=2**-11, atol=1e-7)
        assert np.allclose(r, reference, rtol=2**-11, atol=1e-7)
    start = {"ao": 3, "do": 6, "gi": 3}[effect]
    for (gbuffer, _), (g, _) in zip(written, read, strict=True):  # positions are more exact
        assert np.allclose(g[start : start + 3], gbuffer[start : start + 3], rtol=2**-15)


def test_without_a_probe_and_with_a_wrong_one(tmp_path):
    assert probe.read_probe(replace(bundle(tmp_path), hashes={})) == []
    probe.write_probe(tmp_path / PROBE, "ao", windows(side=12))
    with pytest.raises(BundleError, match="whole multiples of 8"):
        probe.read_probe(bundle(tmp_path))


def test_its_error_is_the_mean_over_the_windows():
    pairs = windows()
    engine = SimpleNamespace(predict=lambda gbuffer: gbuffer[:, :1] / 60)
    expected = np.mean([metrics.dssim(np.clip(g[:1] / 60, 0, 1), r) for g, r in pairs])
    assert probe.dssim(engine, pairs) == pytest.approx(expected)
