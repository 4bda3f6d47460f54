"""Combination of the rigs of several recorders of one lab."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Rig
from ipsys_log.plain_text import shell_words

# These fields describe the computer of a recorder, and not the lab: those of the first rig count.
_OF_COMPUTER = frozenset(("source", "calibration", "stream"))
# Entries with one of these names and the same value there describe the same thing.
_KEYS = ("id", "name")


def combine_rigs(one: Rig, other: Rig, where: tuple[str, str]) -> Rig:
    """Return the rig with the cameras, markers and reference points of two rigs of one lab.

    A value that only one rig has counts. The sources of cameras, their calibration files, and the streams are
    those of the first rig.

    Parameters
    ----------
    where : the names of the logs, for the error.

    Raises
    ------
    IpsysError
        The rigs contradict each other; the text names the first field that differs.

    Examples
    --------
    >>> from ipsys_log.messages import RigMarker
    >>> rigs = [Rig("lab", "DICT_4X4_50", 0.1, (RigMarker(number),)) for number in (1, 2)]
    >>> [marker.id for marker in combine_rigs(*rigs, ("a.mcap", "b.mcap")).markers]
    [1, 2]
    """
    combined: Rig = _combine(one, other, where, "the rig")
    return combined


def _combine(one: Any, other: Any, where: tuple[str, str], place: str) -> Any:
    values = {
        field.name: _combine_value(
            field.name, getattr(one, field.name), getattr(other, field.name), where, place
        )
        for field in fields(one)
    }
    return type(one)(**values)


def _combine_value(name: str, one: Any, other: Any, where: tuple[str, str], place: str) -> Any:
    if one is None or other is None:
        return other if one is None else one
    if one == other or name in _OF_COMPUTER:
        return one
    if is_dataclass(one):
        return _combine(one, other, where, f"{name} of {place}")
    if isinstance(one, tuple):
        return _combine_entries(name, one, other, where)
    raise IpsysError(
        f"{where[0]} and {where[1]} contradict each other: {name} of {place} is {one!r} and {other!r}; "
        f"correct one rig, or leave it out: "
        f"ipsys cut {shell_words(where[1])} -o part.mcap --exclude-topics /rig"
    )


def _combine_entries(name: str, one: tuple[Any, ...], other: tuple[Any, ...], where: tuple[str, str]) -> Any:
    entries = {_key(entry): entry for entry in one}
    for entry in other:
        key = _key(entry)
        place = f"{name.removesuffix('s').replace('_', ' ')} {key}"
        entries[key] = _combine(entries[key], entry, where, place) if key in entries else entry
    return tuple(entries.values())


def _key(entry: Any) -> Any:
    return next(getattr(entry, name) for name in _KEYS if hasattr(entry, name))
