"""The service's fixtures, for the client to talk to."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

_path = Path(__file__).parents[1] / "service" / "conftest.py"
_spec = importlib.util.spec_from_file_location("service_fixtures", _path)
assert _spec
assert _spec.loader
_fixtures = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = _fixtures
_spec.loader.exec_module(_fixtures)

models = _fixtures.models
make_exr = _fixtures.make_exr
make_picture = _fixtures.make_picture
service = _fixtures.service
start = _fixtures.start
start_server = _fixtures.start_server
wait_until = _fixtures.wait_until
