"""Ray Serve's configuration, by Ray's own schema, and the arguments that it hands on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("ray.serve", reason="the extra 'scaling' isn't installed", exc_type=ImportError)


def test_ray_takes_the_configuration(root: Path) -> None:
    from pydantic import ValidationError
    from ray.serve.schema import ServeDeploySchema

    document: dict[str, Any] = yaml.safe_load((root / "deploy/serve.yaml").read_text())
    read = ServeDeploySchema.model_validate(document)
    (application,) = read.applications
    (shading,) = application.deployments
    assert shading.name == "shading"
    with pytest.raises(ValidationError):
        ServeDeploySchema.model_validate({**document, "proxy_location": "Nowhere"})


def test_its_arguments_are_the_application_s(root: Path) -> None:
    from deepshade_service.scaling import Arguments

    (application,) = yaml.safe_load((root / "deploy/serve.yaml").read_text())["applications"]
    asked = Arguments.of(application["args"])
    (shading,) = application["deployments"]
    # a replica gets the CPUs that its networks use, and no more pictures than it takes
    assert asked.threads == shading["ray_actor_options"]["num_cpus"]
    assert asked.workers + asked.queue == shading["max_ongoing_requests"]
    assert asked.settings().memory == 2 * 2**30
    with pytest.raises(TypeError):
        Arguments.of({"thread": "2"})
