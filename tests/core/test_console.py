"""What long jobs say of their progress where there is no terminal."""

from __future__ import annotations

import pytest

from deepshade import console


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "1 s"), (40.4, "40 s"), (720, "12 min"), (12_600, "3.5 h")]
)
def test_durations(seconds: float, text: str) -> None:
    assert console.duration(seconds) == text


def test_a_long_job_says_how_long_it_takes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first unit, which includes what is done but once, doesn't count."""
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with console.Watch("rendering", "views") as watch:
        watch.update(4, 24)  # what is there of an earlier run
        clock[0] = 100.0
        for done in range(5, 12):
            watch.update(done, 24, "loss 0.1")
            clock[0] += 3
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "rendering 5/24  loss 0.1"
    assert lines[1] == "rendering 7/24  loss 0.1"
    assert lines[2] == "20 views take about 60 s, 3 s each"
    assert lines[3] == "rendering 10/24  loss 0.1  42 s left"
    assert len(lines) == 4


def test_a_hidden_one_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with console.Watch("rendering", "views", hidden=True) as watch:
        watch.say("anything")
        for done in range(9):
            watch.update(done, 9)
    assert capsys.readouterr().err == ""
