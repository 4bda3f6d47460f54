"""A short fuzz job: a few cases for each reader of untrusted data; ``scripts/fuzz`` runs many."""

import pytest
from hypothesis import HealthCheck, Phase, given, settings

from tests.fuzz.targets import TARGETS, attack

_CASES = 60


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_ends_with_success_or_one_line(name: str) -> None:
    strategy, act = TARGETS[name]()

    @settings(
        max_examples=_CASES,
        database=None,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def run(given: object) -> None:
        attack(act, given)

    run()
