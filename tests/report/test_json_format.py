"""JSON is in SI units and says its format; ``--json=1`` has the keys of format 1."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.app.report.json_format import old_document
from tests.conftest import Ipsys


def keys(value: Any) -> Iterator[str]:
    """Yield the keys of all objects in a JSON value."""
    if isinstance(value, dict):
        yield from value
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from keys(part)


@pytest.mark.parametrize(
    ("command", "old_keys"),
    [
        (("evaluate", "--model", "poly"), {"mean_cm", "rmse_cm", "bias_cm", "n"}),
        (("align",), {"spread_cm", "tilt_deg", "level_below_cm"}),
        (("plan", "--model", "poly", "--places", "1"), {"mean_before_cm", "mean_after_cm"}),
        (("runs",), set()),
        (("info",), set()),
    ],
)
def test_output_is_in_si_units_and_old_keys_are_on_request(
    command: tuple[str, ...], old_keys: set[str], replayed_lab: Path, ipsys: Ipsys
) -> None:
    name, *options = command
    new, old = (json.loads(ipsys(name, replayed_lab, *options, word).out) for word in ("--json", "--json=1"))
    assert new["format"] == 2
    assert [key for key in keys(new) if re.search("_(cm|mm|deg|ms|us)$", key)] == []
    assert isinstance(old, list) or "format" not in old
    assert old_keys <= set(keys(old))


def test_old_values_are_scaled() -> None:
    result = {
        "mean_m": 0.001,
        "cameras": [{"clock_s": 0.002, "row_time_s": None, "error_m": [0.1, 0.2], "marker_height_m": 0.1}],
    }
    camera = {"clock_ms": 2.0, "row_time_us": None, "error_mm": [100.0, 200.0], "marker_height_m": 0.1}
    assert old_document(result, "calibrate-lab") == {"mean_mm": 1.0, "cameras": [camera]}
    assert old_document({"duration_s": 4.0}, "drive") == {"seconds": 4.0}
    assert old_document(result, "info") == result
