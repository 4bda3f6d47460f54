"""Division of a test's cases between the fast tier and the full tier."""

from collections.abc import Iterable
from typing import Any

import pytest


def first_fast(count: int, cases: Iterable[Any]) -> list[Any]:
    """Return the cases of a parametrised test; those after the first ``count`` run in the full tier only.

    For cases that differ in one step of a long common path, such as the codec of a whole session.
    """
    cases = list(cases)
    return [*cases[:count], *(pytest.param(*_values(case), marks=pytest.mark.slow) for case in cases[count:])]


def _values(case: Any) -> tuple[Any, ...]:
    return case if isinstance(case, tuple) else (case,)
