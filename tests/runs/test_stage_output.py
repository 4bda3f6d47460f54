"""The output of every stage equals the stored output; a change needs a higher version."""

import json
from typing import Any

import numpy as np
import pytest

from ipsys_log.engine.graph import VERSIONS
from tests.runs.stage_output import COMBINATIONS, EXPECTED, TOLERANCES, computed, environment, kind_of


@pytest.fixture(scope="module")
def expected() -> Any:
    return json.loads(EXPECTED.read_text())


def test_output_belongs_to_these_versions(expected: Any) -> None:
    """If the output changes, raise a version and write the file again in the same commit."""
    assert expected["versions"] == VERSIONS


@pytest.mark.slow
@pytest.mark.parametrize(("corners", "method"), COMBINATIONS)
def test_output_of_stages_is_what_it_was(corners: str, method: str, expected: Any) -> None:
    found, before = computed(corners, method), expected[f"{corners} {method}"]
    assert found.keys() == before.keys()
    counts = {topic: row["messages"] for topic, row in found.items()}
    assert counts == {topic: row["messages"] for topic, row in before.items()}
    if environment() == expected["environment"]:
        changed = [topic for topic, row in found.items() if row["sha256"] != before[topic]["sha256"]]
        assert changed == []
    for topic, row in found.items():
        for now, then in zip(row.get("numbers", ()), before[topic].get("numbers", ()), strict=True):
            np.testing.assert_allclose(now, then, rtol=0, atol=TOLERANCES[kind_of(topic)], err_msg=topic)
