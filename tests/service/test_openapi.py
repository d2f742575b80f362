"""The service against its own OpenAPI document: schemathesis makes the requests it describes."""

from __future__ import annotations

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.specs.openapi.checks import positive_data_acceptance

from deepshade.problems import MEDIA_TYPE
from deepshade_service.app import create_app
from deepshade_service.config import Settings

SCHEMA = schemathesis.openapi.from_dict(create_app(Settings()).openapi())
OPERATIONS = {found.ok().label: found.ok() for found in SCHEMA.get_all_operations()}


# A request that the document forbids can be made only where it says anything of requests.
CASES = [
    (mode, label)
    for label, found in OPERATIONS.items()
    for mode in GenerationMode
    if mode is GenerationMode.POSITIVE or list(found.query)
]


usual = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)


@pytest.mark.parametrize(("mode", "label"), CASES)
def test_answers_are_as_described(service, mode, label):
    """No failure inside, only the statuses, media types and bodies that the document names, and
    nothing that it forbids is taken. What it allows may still be no picture.
    """

    @given(case=OPERATIONS[label].as_strategy(generation_mode=mode))
    @usual
    def check(case):
        answer = case.call(base_url=str(service.client.base_url))
        case.validate_response(answer, excluded_checks=[positive_data_acceptance])
        if answer.status_code >= 400:
            assert answer.headers["content-type"][0] == MEDIA_TYPE
            assert answer.json()["detail"]

    check()


@pytest.mark.parametrize("mode", GenerationMode)
def test_any_query_of_a_good_picture_is_answered_or_refused(service, make_exr, mode):
    """Parameters that no body gets in the way of."""
    body = make_exr(16, 24, attributes={"deepshade:fov": 50.0})

    @given(case=OPERATIONS["POST /shade/{effect}"].as_strategy(generation_mode=mode))
    @usual
    def check(case):
        answer = service.client.post(
            "/shade/ao", params=case.query, content=body, headers={"Content-Type": "image/x-exr"}
        )
        assert answer.status_code in (200, 404, 413, 422)
        assert answer.status_code != 200 or answer.content

    check()
