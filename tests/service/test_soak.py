"""The soak in its small form; `benchmarks/soak.py` sends 10,000 requests."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SOAK = Path(__file__).parents[2] / "benchmarks" / "soak.py"


@pytest.mark.slow
def test_mixed_requests_meet_no_failure():
    command = [sys.executable, str(SOAK), "--requests", "40", "--engine", "onnxruntime"]
    found = subprocess.run(command, capture_output=True, text=True, timeout=240)
    result = json.loads(found.stdout)
    assert "Traceback" not in found.stderr
    assert result["status"] == 0 and result["requests"] == 40
    answers = result["answers"]
    assert answers["picture 200"] == 20 and answers["vanished"] == 4
    assert {kind.split()[-1] for kind in answers} <= {"200", "400", "422", "vanished"}
