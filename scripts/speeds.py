"""Puts what `deepshade bench` measured, on a machine that does nothing else, into cards.

deepshade bench --json > speeds.json && python scripts/speeds.py speeds.json
"""

import json
import sys
from pathlib import Path

from deepshade.bundles import Bundle
from deepshade_trainer.card import record_speed

MODELS = Path(__file__).resolve().parent.parent / "models"


def main() -> None:
    """The command."""
    found = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    for name in dict.fromkeys(row["bundle"] for row in found["rows"]):
        times = {row["backend"]: row["ms"] for row in found["rows"] if row["bundle"] == name}
        record_speed(Bundle.load(MODELS / name), found["machine"], times)


if __name__ == "__main__":
    main()
