"""What was typed, in centimetres as the tape reads, into what it says: field by field."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.trilateration import SIDES, sides_alike
from ipsys_log.messages import Distance, ReferencePoint, Rig
from ipsys_log.units import CM_PER_M

__all__ = ["Entry", "Fault", "Typed", "check_references", "needs_side", "read_typed"]

_NUMBER = re.compile(r"\d+(?:[.,]\d*)?|[.,]\d+")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
# Without a floor in the rig, no tape is longer and no marker carried higher.
_LONGEST_M = 30.0
_HIGHEST_M = 5.0
# So near to a reference point hardly anybody measures; to a hundredth of a millimetre, nobody.
_NEAR_CM = 10.0
_METRES = re.compile(r"\d?[.,]\d{3,}")
_LOWEST_CM = 1.0


class Fault(NamedTuple):
    """What cannot be right: ``field`` is ``marker``, ``side``, ``height``, ``id``, ``split``, the name of a
    reference point after ``d_``, or empty where it is about all of it."""

    field: str
    text: str


@dataclass(frozen=True, slots=True)
class Typed:
    """One place as it was typed: text, centimetres. ``distances`` by reference point; empty is not given."""

    marker: str
    distances: Mapping[str, str]
    side: str = ""
    height: str = ""
    split: str = ""
    id: str = ""


@dataclass(frozen=True, slots=True)
class Entry:
    """One place as read from tape and ruler, in m. ``id`` is None where the next free one will do."""

    marker_id: int | None
    distances: tuple[Distance, ...]
    side: str | None
    height_m: float | None
    splits: tuple[str, ...] = ()
    id: str | None = None
    doubts: tuple[str, ...] = ()


def check_references(rig: Rig) -> None:
    """See that a tape can be laid in this lab.

    Raises
    ------
    IpsysError
        Where the rig has fewer than two reference points.
    """
    count = len(rig.reference_points)
    if count < 2:
        has = f"only the reference point {rig.reference_points[0].name}" if count else "no reference points"
        raise IpsysError(
            f"the rig has {has} to lay the tape from: write two or more as [[reference_points]] into "
            "lab.toml and give it with --rig"
        )


def needs_side(rig: Rig, names: Iterable[str]) -> bool:
    """Whether the side must be told where the tape was laid from these reference points."""
    given = set(names)
    at_m = [(p.x_m, p.y_m) for p in rig.reference_points if p.name in given]
    return len(at_m) >= 2 and sides_alike(np.array(at_m))


def read_typed(typed: Typed, rig: Rig) -> tuple[Entry, list[Fault]]:
    """What was typed, and what is wrong or still missing in each field.

    Examples
    --------
    >>> from ipsys_log.messages import ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points)
    >>> entry, faults = read_typed(Typed("3", {"A": "150,5", "B": "1.234"}, "left", "10"), rig)
    >>> entry.distances[0].distance_m, entry.height_m
    (1.505, 0.1)
    >>> faults[0].text
    'distance to B: 1.234 cm looks like metres; type 123.4'
    """
    faults: list[Fault] = []
    doubts: list[str] = []
    marker_id = _marker(typed.marker, rig, faults)
    distances = tuple(_distances(typed, rig, faults, doubts))
    height_m = _height(typed.height, faults, doubts)
    side = typed.side.strip().lower() or None
    if side is not None and side not in SIDES:
        faults.append(Fault("side", f"side {typed.side!r}: write left or right"))
        side = None
    elif side is None and needs_side(rig, (d.reference for d in distances)):
        faults.append(Fault("side", f"left or right of the line from {_line(rig, distances)}?"))
    splits, name = tuple(typed.split.split()), typed.id.strip() or None
    for key, texts in (("split", splits), ("id", (name,) if name else ())):
        bad = [text for text in texts if not _NAME.fullmatch(text)]
        faults += [Fault(key, f"{key} {text!r}: use letters, digits and _") for text in bad]
    entry = Entry(marker_id, distances, side, height_m, splits, name, tuple(doubts))
    return entry, faults


def _line(rig: Rig, distances: tuple[Distance, ...]) -> str:
    given = {d.reference for d in distances}
    names = [p.name for p in rig.reference_points if p.name in given]
    return f"{names[0]} to {names[1]}"


def _marker(text: str, rig: Rig, faults: list[Fault]) -> int | None:
    text = text.strip()
    if not re.fullmatch(r"\d{1,6}", text):
        what = f"{text!r} is no marker id; type a whole number" if text else "which marker?"
        faults.append(Fault("marker", what))
        return None
    if not rig.knows(int(text)):
        known = ", ".join(str(marker.id) for marker in rig.markers)
        faults.append(Fault("marker", f"marker {text} is not in the rig (it has {known})"))
        return None
    return int(text)


def _distances(typed: Typed, rig: Rig, faults: list[Fault], doubts: list[str]) -> Iterator[Distance]:
    given = {name: text.strip() for name, text in typed.distances.items() if text.strip()}
    count = len(rig.reference_points)
    for point in rig.reference_points:
        text = _bare(given.pop(point.name, ""))
        if text:
            value_cm = _number(text, f"distance to {point.name}", f"d_{point.name}", faults)
            fault = None if value_cm is None else _distance_fault(text, value_cm, point, rig)
            if fault is not None:
                faults.append(fault)
            elif value_cm is not None:
                if value_cm < _NEAR_CM:
                    doubts.append(
                        f"distance to {point.name}: {text} cm is very near to {point.name}: in metres? "
                        f"Then type {_times(value_cm)}"
                    )
                yield Distance(point.name, value_cm / CM_PER_M)
        elif count == 2:  # of more, any two will do
            faults.append(Fault(f"d_{point.name}", f"distance to {point.name}?"))
    for name in given:
        faults.append(Fault(f"d_{name}", f"{name} is no reference point of the rig"))
    if count > 2 and sum(bool(text.strip()) for text in typed.distances.values()) < 2:
        faults.append(Fault("", "give two distances or more"))


def _distance_fault(text: str, value_cm: float, point: ReferencePoint, rig: Rig) -> Fault | None:
    """Why a number cannot be a distance in cm."""
    longest_cm = _reach_m(rig, point.x_m, point.y_m) * CM_PER_M
    if value_cm == 0:
        why = "a distance is above 0"
    elif value_cm < _NEAR_CM and _METRES.fullmatch(text):
        why = f"{text} cm looks like metres; type {_times(value_cm)}"
    elif value_cm > longest_cm:
        in_mm = f"; in mm? Then type {value_cm / 10:g}" if value_cm / 10 <= longest_cm else ""
        why = f"{text} cm is further than the floor reaches{in_mm}"
    else:
        return None
    return Fault(f"d_{point.name}", f"distance to {point.name}: {why}")


def _reach_m(rig: Rig, x_m: float, y_m: float) -> float:
    """From a reference point to the furthest corner of the floor."""
    if rig.floor is None:
        return _LONGEST_M
    corners = [(x, y) for x in (0.0, rig.floor.width_m) for y in (0.0, rig.floor.depth_m)]
    return max(float(np.hypot(x - x_m, y - y_m)) for x, y in corners)


def _height(text: str, faults: list[Fault], doubts: list[str]) -> float | None:
    text = _bare(text)
    if not text:
        faults.append(Fault("height", "height? 0 where the marker lies on the floor"))
        return None
    value_cm = _number(text, "height", "height", faults)
    if value_cm is None:
        return None
    if value_cm > _HIGHEST_M * CM_PER_M:
        faults.append(Fault("height", f"height: {text} cm is too high; in mm? Then type {value_cm / 10:g}"))
        return None
    if 0 < value_cm < _LOWEST_CM and len(text.replace(",", ".").partition(".")[2]) > 1:
        faults.append(Fault("height", f"height: {text} cm looks like metres; type {_times(value_cm)}"))
        return None
    if 0 < value_cm < _LOWEST_CM:
        doubts.append(f"height: {text} cm is very low: in metres? Then type {_times(value_cm)}")
    if value_cm > CM_PER_M:
        doubts.append(f"height: {text} cm is high for a marker: is it in mm?")
    return value_cm / CM_PER_M


def _bare(text: str) -> str:
    """A number without the unit that it is asked for in."""
    return re.sub(r"\s*cm$", "", text.strip(), flags=re.IGNORECASE)


def _times(value_cm: float) -> str:
    return f"{value_cm * CM_PER_M:g}"


def _number(text: str, what: str, name: str, faults: list[Fault]) -> float | None:
    if not _NUMBER.fullmatch(text):
        faults.append(Fault(name, f"{what}: {text!r} is no number; type centimetres, such as 123.4"))
        return None
    return float(text.replace(",", "."))
