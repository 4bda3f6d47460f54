"""Natural damage: what is undamaged survives, three readers agree, and a second repair changes nothing.

``IPSYS_DAMAGE_CASES=20000 IPSYS_DAMAGE_SEED=3`` make the slow test longer, and other; `tests.log.damage` is
the same as a script.
"""

import os

import pytest

from tests.log.damage import run


def test_repair_after_natural_damage_converges() -> None:
    complaints: list[str] = []
    totals = run(11, 120, complaints.append)
    assert complaints == []
    assert totals["changed"] > 100


@pytest.mark.slow
def test_repair_after_much_damage_converges() -> None:
    complaints: list[str] = []
    run(
        int(os.environ.get("IPSYS_DAMAGE_SEED", "12")),
        int(os.environ.get("IPSYS_DAMAGE_CASES", "2000")),
        complaints.append,
    )
    assert complaints == []
