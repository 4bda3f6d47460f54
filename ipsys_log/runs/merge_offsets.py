"""Clock offsets of the logs of a merge: given by the user, or estimated from markers that both saw moving."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.runs.merge_plan import LogOffset
from ipsys_log.units import NS_PER_S

__all__ = ["choose_offsets"]

_LARGEST_S = 1_000_000_000


def choose_offsets(paths: Sequence[Path], texts: Sequence[str]) -> list[LogOffset]:
    """Return the offset of each log: of an option ``NAME=SECONDS``, or estimated; 0 for the first log.

    Raises
    ------
    IpsysError
        An option names no log, or an offset cannot be estimated.
    """
    given = _given_offsets(paths, texts)
    return [given.get(number, LogOffset()) for number in range(len(paths))]


def _given_offsets(paths: Sequence[Path], texts: Sequence[str]) -> dict[int, LogOffset]:
    """Return the offsets of the options by the number of their log."""
    given: dict[int, LogOffset] = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        numbers = [number for number, path in enumerate(paths) if name in (str(path), path.name, path.stem)]
        if len(numbers) != 1:
            known = ", ".join(path.stem for path in paths[1:])
            raise IpsysError(
                f"--offset {text}: does not name one log; write NAME=SECONDS with one of {known}"
            )
        if numbers[0] == 0:
            raise IpsysError(f"--offset {text}: the clock of the first log counts; give the other offsets")
        if numbers[0] in given:
            raise IpsysError(f"--offset {text}: the log has two offsets; give one")
        given[numbers[0]] = LogOffset(_parse_seconds(text, value))
    return given


def _parse_seconds(text: str, value: str) -> int:
    try:
        seconds = Decimal(value)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not seconds.is_finite() or abs(seconds) > _LARGEST_S:
        raise IpsysError(f"--offset {text}: is no number of seconds; write it as NAME=0.012")
    return round(seconds * NS_PER_S)
