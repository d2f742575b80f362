"""Headers that fuzzing found to reach code that others don't: read or refused, every time."""

from __future__ import annotations

from pathlib import Path

import pytest

from deepshade import exr
from deepshade.errors import DeepshadeError

FILES = sorted((Path(__file__).parent / "headers").glob("*.exr"))


def test_there_are_some():
    assert len(FILES) > 20


@pytest.mark.parametrize("read", [exr.read_header, exr.read])
def test_each_is_read_or_refused(read):
    for file in FILES:
        try:
            found = read(file.read_bytes(), limits=exr.Limits(pixels=1 << 20))
        except DeepshadeError as error:
            assert str(error)
        else:
            assert found is not None
