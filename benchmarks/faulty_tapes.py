"""Faults of the scale of the tape: see ``contradictions.py``."""

from __future__ import annotations

from collections.abc import Sequence

from fault_trials import Fault

__all__ = ["FAULTS"]

FAULTS: Sequence[Fault] = ()
