"""Makes the tables and pictures of documents: `python -m deepshade_report.effects --help`.

Each effect that one of the documents has a mark for is measured as `deepshade report` does, and
what stands between its marks is replaced; `overview` and `nine` mark tables of all that were
measured. The prose around is the document's own.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from deepshade.bundles import bundle_roots
from deepshade.effects import EFFECTS
from deepshade.errors import DataError, DeepshadeError
from deepshade.files import replacing
from deepshade.machine import cpu_count
from deepshade.manifest import Manifest
from deepshade_report.baselines import folder as baselines_of
from deepshade_report.context import Context, machine
from deepshade_report.method import LIMIT, NETWORK, PAPER, PAPER_NETWORK
from deepshade_report.report import measure
from deepshade_report.sections import Point, Sections, data, points
from deepshade_report.sections.methods import methods, shaded
from deepshade_report.strip import GAIN, chosen, strip, webp
from deepshade_report.view import View
from deepshade_trainer.card import record_speed

WANTED = 32  # views that a mean should rest on
DEFAULT = "balanced"  # the bundle that rivals are held against
_MARKED = re.compile(r"(<!-- made: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


class Figures:
    """What was measured of one effect, sorted by who is compared.

    `ours` are our networks where they run by default, `first` of them the one that rivals are held
    against; `paper` is the paper's, and `alike` our first on its engine, in its precision. `rivals`
    maps each to its setting of least error and the best one that takes no longer than `first`.
    `limits` are no rivals, but what there is to reach: each at its least error.

    Raises DataError: no error or speed of ours was measured, with the reason.
    """

    def __init__(self, sections: Sections) -> None:
        for name in ("error", "speed"):
            if not data(sections, name):
                reason = sections.get(name, {}).get("reason", "it was not measured")
                raise DataError(f"no {name}: {reason}")
        found = points(sections)
        mine = [point for point in found if point.family == NETWORK]
        if not mine:
            raise DataError("no bundle ran")
        self.error = data(sections, "error")
        self.missing: dict[str, str] = self.error["missing"] | data(sections, "speed")["missing"]
        # the first that was measured is on the backend that the rule chooses
        self.ours = list({point.name: point for point in reversed(mine)}.values())[::-1]
        self.first = next((p for p in self.ours if p.name == DEFAULT), self.ours[-1])
        # on its own default backend: 8 bits, ours often, are not for it
        self.paper = next((p for p in found if p.family == PAPER_NETWORK), None)
        self.alike = next(
            (
                p
                for p in mine
                if self.paper and (p.name, p.backend) == (self.first.name, self.paper.backend)
            ),
            None,
        )
        self.rivals: dict[str, tuple[Point, Point | None]] = {}
        self.limits: list[Point] = []
        others = [point for point in found if point.family not in (NETWORK, PAPER_NETWORK)]
        for name in dict.fromkeys(point.name for point in others):
            own = sorted((p for p in others if p.name == name), key=lambda point: point.error)
            if own[0].family == LIMIT:
                self.limits.append(own[0])
                continue
            quick = next((point for point in own if point.cost <= self.first.cost), None)
            self.rivals[name] = own[0], quick

    @property
    def rival(self) -> Point | None:
        """The best setting of the best rival."""
        best = (best for best, _ in self.rivals.values())
        return min(best, key=lambda point: point.error, default=None)

    @property
    def quick(self) -> Point | None:
        """The best of what rivals reach in our time."""
        fitting = (quick for _, quick in self.rivals.values() if quick)
        return min(fitting, key=lambda point: point.error, default=None)


def table(found: Figures) -> list[str]:
    """Markdown: every method of one effect."""
    error = found.error
    lines = [
        "| | setting | DSSIM | of doing nothing | SMAPE | ms |",
        "|---|---|---|---|---|---|",
        f"| doing nothing | | {_plus(error['trivial_dssim'], error['trivial_standard_error'])} "
        f"| 100 % | {_short(error['trivial_relative'])} | |",
    ]
    lines += [_line(f"**`{point.name}`**", point, point.backend) for point in found.ours]
    if found.paper:
        lines.append(_line("the paper's network, our recipe", found.paper, found.paper.backend))
        if found.alike and found.alike not in found.ours:
            lines.append(_line(f"`{found.alike.name}`, alike", found.alike, found.alike.backend))
    for name, (best, quick) in found.rivals.items():
        lines.append(_line(name, best, _setting(best)))
        if quick is None:
            lines.append(f"| {name} in our time | none is as quick | | | | |")
        elif quick is not best:
            lines.append(_line(f"{name} in our time", quick, _setting(quick)))
    lines += [_line(point.name, point, _setting(point)) for point in found.limits]
    if (floor := error["floor"]) is not None:
        share = 100 * floor / error["trivial_dssim"]
        lines.append(f"| noise in the reference | | {_short(floor)} | {share:.1f} % | | |")
    return lines


def overview(found: dict[str, Figures]) -> list[str]:
    """Markdown: a line for each effect, errors as shares of the trivial answer's."""
    lines = [
        "| | views | doing nothing, DSSIM | ours | best rival | rival in our time "
        "| the paper's network | ours, ms | the paper's, ms | ours alike, ms | best rival, ms |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for effect, each in found.items():
        others = (each.rival, each.quick, each.paper)
        shares = [f"{100 * p.of_trivial:.1f} %" if p else "-" for p in (each.first, *others)]
        times = [_ms(p) if p else "-" for p in (each.first, each.paper, each.alike, each.rival)]
        facts = [str(each.error["views"]), _short(each.error["trivial_dssim"])]
        title = f"[{EFFECTS[effect].title}](#{effect})"
        lines.append(f"| {' | '.join([title, *facts, *shares, *times])} |")
    return lines


def nine(found: dict[str, Figures]) -> list[str]:
    """Markdown: a line for each effect, the paper's own figures beside what was measured here."""
    lines = [
        "| | paper: SSIM | ms | doing nothing: SSIM "
        "| ours: SSIM | error | ms | best rival | error | ms |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for effect, each in found.items():
        published = getattr(baselines_of(effect), "PUBLISHED", None)
        theirs = [_three(published[1]), f"{published[0]:.3g}"] if published else ["-", "-"]
        ssims = [1 - 2 * each.error["trivial_dssim"], 1 - 2 * each.first.error]
        ours = [f"{100 * each.first.of_trivial:.1f} %", _ms(each.first)]
        rival = each.rival
        last = [rival.name, f"{100 * rival.of_trivial:.1f} %", _ms(rival)] if rival else ["-"] * 3
        row = [EFFECTS[effect].title, *theirs, *(_three(ssim) for ssim in ssims), *ours, *last]
        lines.append(f"| {' | '.join(row)} |")
    return lines


def draw(context: Context, found: Figures, folder: Path) -> list[str]:
    """Markdown: two held-out views as strips, which are written into `folder`."""
    every, _ = methods(context)
    rival = found.rival if found.rival and found.rival.id in every else None
    shown = [every[found.first.id]] + ([every[rival.id]] if rival else [])
    names = ["ours", "reference", *([rival.name] if rival else []), "our difference"]
    if (first := context.views[0].origin) is not None:
        names.insert(0, first)
    lines: list[str] = []
    folder.mkdir(parents=True, exist_ok=True)
    for number, view in enumerate(chosen(context.views), 1):
        images = []
        for method in shown:
            method.prepare(view)
            images.append(shaded(method, view))
        file = folder / f"{context.effect}-{number}.webp"
        with replacing(file) as part:
            part.write_bytes(webp(strip(view, *images)))
        errors = [_short(view.dssim(image)) for image in (view.trivial(), *images)]
        told = f"`{_scene(view)}`: DSSIM of doing nothing {errors[0]}, ours {errors[1]}"
        told += f", {rival.name} {errors[2]}." if rival else "."
        where = file.relative_to(folder.parent.parent).as_posix()
        lines += [f"![{', '.join(names)}]({where})", "", told, ""]
    return lines


def fragment(context: Context, found: Figures, folder: Path) -> str:
    """What stands between an effect's marks."""
    lines = [*draw(context, found, folder), *table(found), ""]
    views, size = found.error["views"], " x ".join(map(str, found.error["size"]))
    scenes = ", ".join(sorted({f"`{_scene(view)}`" for view in context.views}))
    threads = f"{context.threads} thread{'s' * (context.threads > 1)}"
    lines += [f"Means over {views} view{'s' * (views > 1)} of {size} ({scenes}), ± standard error."]
    if views < WANTED:
        lines += [f"These are fewer than the {WANTED} views that such a mean should rest on."]
    lines += [f"{machine()['processor']}, {threads}, whole frames of 768 x 512, all in one run."]
    lines += [f"Left out: {name} ({why})." for name, why in found.missing.items()]
    return "\n".join(lines) + "\n"


def write(
    documents: Sequence[Path], context_of: Callable[[str], Context], *, resume: bool = False
) -> dict[str, str]:
    """Measure all effects that `documents` have marks for, once, and renew these.

    Returns what went wrong, by effect. Pictures go into images/effects beside the first document.
    `resume` keeps what `Context.out` holds.
    """
    texts = {document: document.read_text("utf-8") for document in documents}
    found: dict[str, Figures] = {}
    made: dict[str, str] = {}
    wrong: dict[str, str] = {}
    marked = [name for text in texts.values() for _, name, _ in _MARKED.findall(text)]
    for name in dict.fromkeys(name for name in marked if name in EFFECTS):
        try:
            context = context_of(name)
            report: dict[str, Any] = measure(
                context, only=("error", "speed"), resume=resume, progress=partial(_tell, name)
            )
            found[name] = figures = Figures(report["sections"])
            made[name] = fragment(context, figures, documents[0].parent / "images" / "effects")
            if not context.quick:
                _to_cards(context, figures)
        except DeepshadeError as problem:
            wrong[name] = str(problem)
            made[name] = f"Not measured: {problem}.\n"
    made["overview"] = "\n".join(overview(found)) + "\n"
    made["nine"] = "\n".join([*nine(found), "", _where(found)]) + "\n"
    for document, text in texts.items():
        with replacing(document) as part:
            part.write_text(_MARKED.sub(lambda m: m[1] + made.get(m[2], "") + m[3], text), "utf-8")
    return wrong


def _tell(effect: str, section: str, share: float, doing: str) -> None:
    print(f"{effect} {section} {share:4.0%} {doing}", flush=True)


def _to_cards(context: Context, found: Figures) -> None:
    """Our times, so that cards and pages say the same."""
    for bundle in context.served:
        points = [p for p in (*found.ours, found.alike) if p and p.name == bundle.name]
        times = {point.backend: round(point.milliseconds, 4) for point in points}
        record_speed(bundle, str(machine()["processor"]), times)


def data_of(effect: str, folders: Sequence[Path]) -> Path:
    """The first of the data sets that has the effect's reference, else the first of all."""
    layer = f"reference_{effect}"
    return next((f for f in folders if layer in Manifest.read(f).schema), folders[0])


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Renews the tables and pictures of a document.")
    parser.add_argument(
        "--data",
        type=Path,
        nargs="+",
        required=True,
        help="held-out views; of several sets an effect's are in the first that has its reference",
    )
    parser.add_argument("--models", type=Path, action="append", help="<effect>/<name>/; repeatable")
    parser.add_argument("--paper", type=Path, help="<effect>/paper/ lie here (default: --models)")
    parser.add_argument(
        "--document",
        type=Path,
        nargs="+",
        default=[Path("docs/effects.md"), Path("README.md")],
        help="pictures go beside the first",
    )
    parser.add_argument("--out", type=Path, default=Path("out/effects"), help="reports, by effect")
    parser.add_argument("--threads", type=int, default=cpu_count())
    parser.add_argument("--views", type=int, help="held-out views of an effect, at most")
    parser.add_argument("--quick", action="store_true", help="rough: two views, few rounds")
    parser.add_argument("--resume", action="store_true", help="keep what --out holds already")
    asked = parser.parse_args()

    def context_of(effect: str) -> Context:
        paper = asked.paper / effect / PAPER if asked.paper else None
        return Context(
            bundle_roots(asked.models or ()),
            data_of(effect, asked.data),
            asked.out / effect,
            paper if paper and paper.is_dir() else None,
            effect,
            asked.threads,
            asked.quick,
            asked.views,
        )

    for effect, why in write(asked.document, context_of, resume=asked.resume).items():
        print(f"{effect} is not measured: {why}")
    print(f"{', '.join(map(str, asked.document))}; differences are shown {GAIN:g} times as large")


def _line(name: str, point: Point, setting: str) -> str:
    error = _plus(point.error, point.standard_error)
    share, relative = f"{100 * point.of_trivial:.1f} %", _short(point.relative)
    return f"| {name} | {setting} | {error} | {share} | {relative} | {_ms(point)} |"


def _where(found: dict[str, Figures]) -> str:
    """What the figures of all effects have in common."""
    views = [each.error["views"] for each in found.values()]
    count = f"{min(views)} to {max(views)}" if len(set(views)) > 1 else str(max(views, default=0))
    return (
        f"{count} held-out views an effect; {machine()['processor']}, whole frames of 768 x 512, "
        "all in one run."
    )


def _three(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")


def _setting(point: Point) -> str:
    return ", ".join(f"{name} {value}" for name, value in point.settings.items())


def _plus(value: float, error: float | None) -> str:
    return _short(value) + (f" ± {_short(error)}" if error is not None else "")


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}".removeprefix("0")


def _ms(point: Point) -> str:
    return f"{point.milliseconds:.3g}" if point.milliseconds < 100 else f"{point.milliseconds:.0f}"


def _scene(view: View) -> str:
    return Path(view.scene).stem


if __name__ == "__main__":
    main()
