"""Faults of sides, points and cameras that contradict a joint calibration: see ``contradictions.py``."""

from __future__ import annotations

from collections.abc import Sequence

from fault_trials import Fault

__all__ = ["FAULTS"]

FAULTS: Sequence[Fault] = ()
