"""The page holds everything itself, and the JSON is what its schema says."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from deepshade_report import plots, run, style
from deepshade_report.context import Context
from deepshade_report.sections.comparison import PICTURE

from .sections import made_up

VOID = {"meta", "img", "br", "link", "input", "hr"}
LOADING = ("src", "href", "xlink:href", "data", "poster", "srcset", "action")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole report of made-up figures."""
    out = tmp_path_factory.mktemp("report")
    (out / PICTURE).write_bytes(b"\x89PNG made up")
    run.write(Context(out, out, out), made_up(), 1.0)
    return out


class Reader(HTMLParser):
    """Tags that must close, ids, and everything that could be loaded."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        self._note(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._note(attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def _note(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(str(value))
            if name in LOADING:
                self.links.append(str(value))


def read(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    return reader


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(folder: Path) -> None:
    text = (folder / "index.html").read_text()
    found = read(text)
    assert found.links
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in found.links)
    assert not found.tags & {"script", "link", "iframe", "object"}
    assert not re.search(r"@import|url\((?!#)", text)
    spaces = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert set(re.findall(r"https?://[^\"'\s<]+", text)) <= spaces  # names, not addresses


@pytest.mark.slow
def test_ids_are_unique_and_what_refers_to_them_finds_them(folder: Path) -> None:
    text = (folder / "index.html").read_text()
    found = read(text)
    assert len(found.ids) == len(set(found.ids))
    wanted = {link[1:] for link in found.links if link.startswith("#")}
    wanted |= set(re.findall(r"url\(#([^)]+)\)", text))
    assert wanted <= set(found.ids)


@pytest.mark.slow
def test_both_colour_schemes_are_there_and_plots_follow_them(folder: Path) -> None:
    text = (folder / "index.html").read_text()
    assert "prefers-color-scheme:dark" in text
    assert "color-scheme:light dark" in text
    inside = "".join(re.findall(r"<svg.*?</svg>", text, re.DOTALL))
    assert inside.count("var(--ink)") > 50
    own = {light for light, _ in style.PALETTE.values()}
    assert not own & set(re.findall(r"#[0-9a-f]{6}\b", inside))


def test_text_and_background_have_enough_contrast_in_both_schemes() -> None:
    def light(colour: str) -> float:
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    for scheme in (0, 1):  # WCAG 2: 4.5 for text
        paper = light(style.PALETTE["paper"][scheme])
        for name in ("ink", "soft"):
            high, low = sorted((light(style.PALETTE[name][scheme]), paper), reverse=True)
            assert (high + 0.05) / (low + 0.05) >= 4.5


@pytest.mark.slow
def test_all_that_was_measured_is_shown_escaped(folder: Path) -> None:
    text = (folder / "index.html").read_text()
    assert "&lt;not&gt; here" in text
    assert "<not>" not in text
    for word in ("Targets", "not met", "GTX 980 Ti", "No GPU here", "best openvino/bf16"):
        assert word in text
    for name in plots.PLOTS:
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert text.count("<svg") == len(plots.PLOTS)


@pytest.mark.slow
def test_the_json_is_what_the_schema_says(folder: Path) -> None:
    schema = json.loads(files("deepshade_report").joinpath("report.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    report = json.loads((folder / "report.json").read_text())
    jsonschema.Draft202012Validator(schema).validate(report)
    report["sections"]["speed"]["data"]["rows"][0]["ms"]["median"] = "fast"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(schema).validate(report)


@pytest.mark.parametrize("missing", [*run.SECTIONS, "everything"])
def test_a_section_that_was_skipped_is_said_with_its_reason(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # to draw takes long, so only whether there would be a plot
    drawn: list[str] = []
    for name, (title, plot) in plots.PLOTS.items():
        monkeypatch.setitem(plots.PLOTS, name, (title, _noting(drawn, name, plot)))
    sections: dict[str, Any] = made_up()
    for name in list(sections) if missing == "everything" else [missing]:
        sections[name] = {"status": "skipped", "reason": "no <shards>", "key": "test"}
    run.write(Context(tmp_path, tmp_path, tmp_path), sections, 1.0, partial_=True)
    text = (tmp_path / "index.html").read_text()
    read(text)
    assert "Skipped: no &lt;shards&gt;" in text
    assert "stopped before the end" in text
    gone = {"everything": 7, "error": 2, "speed": 2, "gpu": 0, "comparison": 0}
    assert len(drawn) == len(plots.PLOTS) - gone.get(missing, 1)


def _noting(drawn: list[str], name: str, plot: Callable[..., Any]) -> Callable[..., None]:
    def note(sections: dict[str, Any]) -> None:
        if plot(sections) is not None:
            drawn.append(name)

    return note
