"""What fine-tuning to one scene brings there, and costs elsewhere.

    python benchmarks/finetune.py ao --scene living_room.gltf                  # about an hour
    python benchmarks/finetune.py gi --scene living_room.gltf --minutes 10
    python benchmarks/finetune.py ao --scene living_room.gltf --work out/tuned # goes on there

Renders 64 views of a scene that no bundle was trained on, 24 others of it, and procedural views
to rehearse and to judge by; fine-tunes the effect's `balanced` as the trainer service does; then
shades the other views by both. Passes where DSSIM on those is at least 12 % lower, and on
procedural scenes at most 3 % higher.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import torch

from deepshade import pictures
from deepshade.bundles import Bundle, bundle_root
from deepshade.effects import EFFECTS
from deepshade.files import replacing
from deepshade.machine import cpu_count
from deepshade_trainer.evaluation import Row, evaluate
from deepshade_trainer.tuning.finetune import finetune
from deepshade_trainer.tuning.finished import candidate
from deepshade_trainer.tuning.plan import Plan
from deepshade_trainer.tuning.verdict import Paired

LOWER, HIGHER = 0.12, 0.03
# name -> views, seed, rays a pixel, whether of the scene
SETS = {
    "own": (64, 101, 128, True),
    "others": (24, 102, 1024, True),  # with less the references' own noise hides what is gained
    "rehearsal": (96, 201, 128, False),
    "test": (36, 202, 1024, False),
}


def render(options: argparse.Namespace, name: str) -> Path:
    """A data set, unless it is there."""
    views, seed, spp, own = SETS[name]
    out = options.work / options.effect / name
    words = ["--out", out, "--scenes", options.scene if own else "procedural", "--views", views]
    words += ["--effects", options.effect, "--seed", seed, "--spp", spp, "--frame", 512]
    command = [sys.executable, "-m", "deepshade.cli", "datagen", *map(str, words)]
    subprocess.run(command, check=True)
    return Path(out)


def pair(base: list[Row], tuned: list[Row]) -> Paired:
    """Both bundles' errors on the same views."""
    return Paired.of(*([row.figures["dssim"] for row in rows] for rows in (base, tuned)))


def main() -> int:
    """Exits with 1 where a bound is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("effect", choices=EFFECTS)
    parser.add_argument("--scene", required=True, help="mesh that no bundle was trained on")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--steps", type=int, default=0, help="instead of minutes")
    parser.add_argument("--lr", type=float, default=0.0)
    parser.add_argument("--threads", type=int, default=cpu_count())
    parser.add_argument("--work", type=Path, default=Path("out/finetune"))
    options = parser.parse_args()
    folders = {name: render(options, name) for name in SETS}
    base = bundle_root() / options.effect / "balanced"
    plan = Plan(
        effect=options.effect,
        base=str(base),
        name="balanced",
        data=(str(folders["own"]),),
        rehearsal=(str(folders["rehearsal"]),),
        test=(str(folders["test"]),),
        minutes=options.minutes,
        steps=options.steps,
        lr=options.lr,
        threads=options.threads,
    )
    torch.set_num_threads(plan.threads)
    job = options.work / options.effect / f"job-{plan.key()[:12]}"
    event = {}
    for event in finetune(plan, job):
        if event["phase"] != "training" or event.get("validation"):
            print(json.dumps({k: v for k, v in event.items() if k != "decision"}), flush=True)
    if event.get("phase") != "judged":
        return 130
    print(event["decision"]["sentence"])
    bundles = Bundle.load(base), Bundle.load(candidate(job, plan))
    before, after = (list(evaluate(bundle, [folders["others"]])) for bundle in bundles)
    others, test = pair(before, after), event["decision"]["test"]["test"]
    print(f"other views of the scene: {others.told()}; procedural {100 * test['change']:+.1f} %")
    effect = EFFECTS[options.effect]
    rows = [
        pictures.beside([pictures.of_effect(image, effect) for image in images])
        for images in ((b.image, a.image, a.reference) for b, a in zip(before, after, strict=True))
    ]
    sheet = options.work / options.effect / "before-after-reference.png"
    pictures.save(sheet, pictures.below(rows[:6]))
    found = {
        "others": others.change,
        "procedural": test["change"],
        "steps": event["decision"]["steps"],
    }
    with replacing(job / "benchmark.json") as temporary:
        temporary.write_text(json.dumps(found))
    print(f"before, after, reference: {sheet}")
    return int(others.change > -LOWER or test["change"] > HIGHER)


if __name__ == "__main__":
    sys.exit(main())
