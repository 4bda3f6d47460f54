"""Parser of typed measurements: text fields in centimetres become an entry in metres, or faults."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.row_files import with_decimal_point
from ipsys_log.messages import Distance, ReferencePoint, Rig
from ipsys_log.plain_text import join_names
from ipsys_log.units import CM_PER_M
from ipsys_log.vision.trilateration import SIDES, are_collinear

_NUMBER = re.compile(r"\d+(?:[.,]\d*)?|[.,]\d+")
_ZERO = re.compile(r"0+(?:[.,]0*)?")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
# Longest distance if the rig has no floor, and largest height of a marker.
_LONGEST_M = 30.0
_HIGHEST_M = 5.0
# A shorter distance may be in metres. With three decimals or more, it is a fault, else only a doubt.
_NEAR_CM = 10.0
_METRES = re.compile(r"\d?[.,]\d{3,}")
_LOWEST_CM = 1.0
# No tape differs from the distance AB of the rig by more than this share of it.
_FAR_FROM_AB = 0.05


class Fault(NamedTuple):
    """An error in an entry.

    ``field`` is ``marker``, ``side``, ``height``, ``id``, ``split``, or ``d_`` and the name of a reference
    point. It is empty if the fault is in the whole entry.
    """

    field: str
    text: str


@dataclass(frozen=True, slots=True)
class TypedEntry:
    """One calibration point as it was typed: texts, in centimetres.

    ``distances`` are by reference point. An empty text means that the value is missing.
    """

    marker: str
    distances: Mapping[str, str]
    side: str = ""
    height: str = ""
    split: str = ""
    id: str = ""


@dataclass(frozen=True, slots=True)
class Entry:
    """One calibration point as read from tape and ruler, in m; ``id`` None means the next free id."""

    marker_id: int | None
    distances: tuple[Distance, ...]
    side: str | None
    height_m: float | None
    splits: tuple[str, ...] = ()
    id: str | None = None
    doubts: tuple[str, ...] = ()


def check_references(rig: Rig) -> None:
    """Check that the rig has enough reference points for tape measurements."""
    count = len(rig.reference_points)
    if count < 2:
        present = (
            f"only the reference point {rig.reference_points[0].name}" if count else "no reference points"
        )
        raise IpsysError(
            f"the rig has {present}, but a tape needs two; write two or more as [[reference_points]] into "
            "lab.toml and give it with --rig"
        )


def needs_side(rig: Rig, names: Iterable[str]) -> bool:
    """Return whether distances from these reference points need a side (left or right)."""
    used = set(names)
    points_m = [(p.x_m, p.y_m) for p in rig.reference_points if p.name in used]
    return len(points_m) >= 2 and are_collinear(np.array(points_m))


def parse_entry(typed: TypedEntry, rig: Rig) -> tuple[Entry, list[Fault]]:
    """Parse typed texts; return the entry, and the faults and missing values of each field.

    Examples
    --------
    >>> from ipsys_log.messages import ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points)
    >>> entry, faults = parse_entry(TypedEntry("3", {"A": "150,5", "B": "1.234"}, "left", "10"), rig)
    >>> entry.distances[0].distance_m, entry.height_m
    (1.505, 0.1)
    >>> faults[0].text
    'distance to B: 1.234 cm looks like metres; type 123.4'

    A marker on a reference point has the distance 0, and needs no other:

    >>> parse_entry(TypedEntry("3", {"A": "0"}, "", "0"), rig)[1]
    []
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


def parse_baseline(text: str, rig: Rig) -> tuple[float, Fault | None]:
    """Return the distance in m between the first two reference points, typed in cm, or the fault."""
    first, second, *_ = rig.reference_points
    faults: list[Fault] = []
    named = f"distance from {first.name} to {second.name}"
    read_cm = _number(_bare(text), named, "ab", faults)
    known_cm = float(np.hypot(second.x_m - first.x_m, second.y_m - first.y_m)) * CM_PER_M
    if read_cm is not None and abs(read_cm - known_cm) > _FAR_FROM_AB * known_cm:
        faults.append(
            Fault("ab", f"{named}: {read_cm:g} cm, but {known_cm:.1f} cm in the rig; correct one of them")
        )
    return (read_cm or 0.0) / CM_PER_M, faults[0] if faults else None


def _line(rig: Rig, distances: tuple[Distance, ...]) -> str:
    used = {d.reference for d in distances}
    names = [p.name for p in rig.reference_points if p.name in used]
    return f"{names[0]} to {names[1]}"


def _marker(text: str, rig: Rig, faults: list[Fault]) -> int | None:
    text = text.strip()
    if not re.fullmatch(r"\d{1,6}", text):
        message = f"{text!r} is not a marker id; type a whole number" if text else "which marker?"
        faults.append(Fault("marker", message))
        return None
    if not rig.knows(int(text)):
        ids = join_names([str(marker.id) for marker in rig.markers])
        faults.append(Fault("marker", f"marker {text} is not in the rig (it has {ids})"))
        return None
    return int(text)


def _distances(typed: TypedEntry, rig: Rig, faults: list[Fault], doubts: list[str]) -> Iterator[Distance]:
    texts = {name: text.strip() for name, text in typed.distances.items() if text.strip()}
    count = len(rig.reference_points)
    on_reference = [p.name for p in rig.reference_points if _ZERO.fullmatch(_bare(texts.get(p.name, "")))]
    if on_reference and len(texts) == 1:
        yield Distance(on_reference[0], 0.0)
        return
    for point in rig.reference_points:
        text = _bare(texts.pop(point.name, ""))
        if text:
            value_cm = _number(text, f"distance to {point.name}", f"d_{point.name}", faults)
            fault = None if value_cm is None else _distance_fault(text, value_cm, point, rig)
            if fault is not None:
                faults.append(fault)
            elif value_cm is not None:
                if value_cm < _NEAR_CM:
                    doubts.append(
                        f"distance to {point.name}: {text} cm is very short; if it is in metres, "
                        f"type {_times(value_cm)}"
                    )
                yield Distance(point.name, value_cm / CM_PER_M)
        elif count == 2:  # with more reference points, any two distances are enough
            faults.append(Fault(f"d_{point.name}", f"distance to {point.name}?"))
    for name in texts:
        faults.append(Fault(f"d_{name}", f"{name} is not a reference point of the rig"))
    if count > 2 and sum(bool(text.strip()) for text in typed.distances.values()) < 2:
        faults.append(Fault("", "give two distances or more"))


def _distance_fault(text: str, value_cm: float, point: ReferencePoint, rig: Rig) -> Fault | None:
    """Return a fault if a number cannot be a distance in cm, else None."""
    longest_cm = _reach_m(rig, point.x_m, point.y_m) * CM_PER_M
    if value_cm == 0:
        reason = "0 means on this point: leave the other distances empty, or type a number above 0"
    elif value_cm < _NEAR_CM and _METRES.fullmatch(text):
        reason = f"{text} cm looks like metres; type {_times(value_cm)}"
    elif value_cm > longest_cm:
        in_mm = f"; if it is in mm, type {value_cm / 10:g}" if value_cm / 10 <= longest_cm else ""
        reason = f"{text} cm is longer than the floor{in_mm}"
    else:
        return None
    return Fault(f"d_{point.name}", f"distance to {point.name}: {reason}")


def _reach_m(rig: Rig, x_m: float, y_m: float) -> float:
    """Return the distance from a reference point to the furthest corner of the floor, in m."""
    if rig.floor is None:
        return _LONGEST_M
    corners = [(x, y) for x in (0.0, rig.floor.width_m) for y in (0.0, rig.floor.depth_m)]
    return max(float(np.hypot(x - x_m, y - y_m)) for x, y in corners)


def _height(text: str, faults: list[Fault], doubts: list[str]) -> float | None:
    text = _bare(text)
    if not text:
        faults.append(Fault("height", "height? 0 if the marker is on the floor"))
        return None
    value_cm = _number(text, "height", "height", faults)
    if value_cm is None:
        return None
    if value_cm > _HIGHEST_M * CM_PER_M:
        faults.append(
            Fault("height", f"height: {text} cm is too high; if it is in mm, type {value_cm / 10:g}")
        )
        return None
    if 0 < value_cm < _LOWEST_CM and len(with_decimal_point(text).partition(".")[2]) > 1:
        faults.append(Fault("height", f"height: {text} cm looks like metres; type {_times(value_cm)}"))
        return None
    if 0 < value_cm < _LOWEST_CM:
        doubts.append(f"height: {text} cm is very low; if it is in metres, type {_times(value_cm)}")
    if value_cm > CM_PER_M:
        doubts.append(f"height: {text} cm is high for a marker; if it is in mm, type {value_cm / 10:g}")
    return value_cm / CM_PER_M


def _bare(text: str) -> str:
    """Remove the unit cm and spaces from a typed number."""
    return re.sub(r"\s*cm$", "", text.strip(), flags=re.IGNORECASE)


def _times(value_cm: float) -> str:
    return f"{value_cm * CM_PER_M:g}"


def _number(text: str, item_name: str, name: str, faults: list[Fault]) -> float | None:
    if not _NUMBER.fullmatch(text):
        faults.append(Fault(name, f"{item_name}: {text!r} is not a number; type centimetres, such as 123.4"))
        return None
    return float(with_decimal_point(text))
