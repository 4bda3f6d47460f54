"""Checks of a rig: values in a wrong unit, marker ids that do not exist, and bodies."""

import math
import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Rig, RigBody, RigMarker

LARGEST_SCALE_SIGMA = 0.05  # of a tape: a stick that somebody made; of a body: a print of another size
_LARGEST_BODY_M = 5.0  # from the centre of a marker to another one, or to the pivot


class _Kind(NamedTuple):
    """The unit and the plausible range of a value, and the units that users confuse with it, as factors."""

    unit: str
    low: float
    high: float
    others: tuple[tuple[str, float], ...] = ()


_LENGTHS = (("cm", 0.01), ("mm", 0.001))
# By the key in the rig file. A value outside the range has another unit. A row time of 0 is also valid.
_KINDS = {
    "marker_length_m": _Kind("m", 0.002, 2.0, _LENGTHS),
    "length_m": _Kind("m", 0.002, 2.0, _LENGTHS),
    "tape_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "ab_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "marker_height_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "height_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "width_m": _Kind("m", 0.0, 100.0, _LENGTHS),
    "depth_m": _Kind("m", 0.0, 100.0, _LENGTHS),
    "x_m": _Kind("m", -100.0, 100.0, _LENGTHS),
    "y_m": _Kind("m", -100.0, 100.0, _LENGTHS),
    "rate_hz": _Kind("Hz", 0.0, 1000.0),
    "exposure_s": _Kind("s", 0.0, 1.0, (("ms", 1e-3), ("us", 1e-6))),
    "row_time_ns": _Kind("ns", 1000, 1_000_000, (("us", 1e3),)),
    "edge_offset_px": _Kind("px", -5.0, 5.0),
}

# Number of markers of each dictionary whose name does not contain this number.
_SIZES = {
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_16H5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_25H9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36H10": 2320,
    "DICT_APRILTAG_36h11": 587,
    "DICT_APRILTAG_36H11": 587,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_ARUCO_MIP_36H12": 250,
}


def check_units(rig: Rig, where: str) -> None:
    """Check that no value of a rig file is in a wrong unit, and that its markers exist.

    Raises
    ------
    IpsysError
        A value is impossible in a lab (the text contains the value in the probable unit), or the dictionary
        does not contain a marker id.
    """
    for item, key, value in _given(rig):
        kind = _KINDS[key]
        if kind.low <= value <= kind.high:
            continue
        meant = [(unit, value * factor) for unit, factor in kind.others]
        likely = [
            f"{number:g} if it is in {unit}" for unit, number in meant if kind.low <= number <= kind.high
        ]
        then = " or ".join(likely) or f"{kind.low:g} to {kind.high:g}"
        raise IpsysError(f"{where}: {item}{key} = {value:g} is too {_far(value, kind)}; write {then}")
    size = dictionary_size(rig.dictionary)
    for marker in rig.all_markers:
        if size is not None and marker.id >= size:
            raise IpsysError(
                f"{where}: marker id {marker.id}: {rig.dictionary} has only the ids 0 to {size - 1}; correct "
                "the id, or the dictionary of the print"
            )


def _far(value: float, kind: _Kind) -> str:
    """Return the text that a value is too large or too small for its unit."""
    return f"large for {kind.unit}" if value > kind.high else f"small for {kind.unit}"


def dictionary_size(dictionary: str) -> int | None:
    """Return the number of markers of an OpenCV dictionary; None for an unknown dictionary.

    Examples
    --------
    >>> dictionary_size("DICT_4X4_100"), dictionary_size("DICT_APRILTAG_16h5")
    (100, 30)
    """
    named = re.fullmatch(r"DICT_\dX\d_(\d+)", dictionary)
    return int(named[1]) if named else _SIZES.get(dictionary)


def _given(rig: Rig) -> Iterator[tuple[str, str, float]]:
    """Yield the values with a plausible range: the item of the rig, the key, and the value."""
    items: list[tuple[str, object]] = [
        ("", rig),
        *((f"marker {marker.id}: ", marker) for marker in rig.all_markers),
    ]
    items += [("[floor] ", rig.floor)]
    items += [(f"reference point {point.name}: ", point) for point in rig.reference_points]
    items += [(f"camera {camera.name}: ", camera) for camera in rig.cameras]
    for name, item in items:
        for key in _KINDS:
            value = getattr(item, key, None)
            if value is not None and not (key == "row_time_ns" and value == 0):
                yield name, key, value


def check_bodies(rig: Rig, where: str) -> None:
    """Check that each robot with several markers is a body, and that bodies have markers with poses."""
    check_unique((body.robot for body in rig.bodies), f"{where}: two bodies have the robot")
    markers: dict[str, list[RigMarker]] = {}
    for marker in rig.markers:
        if marker.robot is not None:
            markers.setdefault(marker.robot, []).append(marker)
    bodies = {body.robot for body in rig.bodies}
    for robot, own in markers.items():
        if len(own) > 1 and robot not in bodies:
            raise IpsysError(
                f"{where}: robot {robot!r} has several markers; add [[bodies]] with this robot, and with "
                "level = true if it stays level"
            )
        check_unique(
            (marker.xyz_m for marker in own if marker.xyz_m), f"{where}: two markers of {robot} are at"
        )
    for body in rig.bodies:
        if body.scale_sigma is not None and not 0 < body.scale_sigma <= LARGEST_SCALE_SIGMA:
            raise IpsysError(
                f"{where}: scale_sigma of {body.robot} is {body.scale_sigma:g}; write 0.001 for 0.1 %"
            )
        if body.robot not in markers:
            raise IpsysError(
                f"{where}: no marker has the robot {body.robot!r} of [[bodies]]; name it in [[markers]]"
            )
        unknown = [m.id for m in markers[body.robot] if body.level and rig.height_of(m.id) is None]
        if unknown:
            raise IpsysError(
                f"{where}: {body.robot} is level, but its marker {unknown[0]} has no height_m; write it, or "
                "level = false"
            )
        _check_triples(body, ("pivot_m", "pivot_rpy_rad"), f"{where}: {{}} of {body.robot}")
    for marker in rig.markers:
        _check_triples(marker, ("xyz_m", "rpy_rad"), f"{where}: {{}} of marker {marker.id}")


def _check_triples(item: RigMarker | RigBody, keys: Iterable[str], where: str) -> None:
    for key in keys:
        numbers, name = getattr(item, key), where.format(key)
        if numbers and (len(numbers) != 3 or not all(map(math.isfinite, numbers))):
            raise IpsysError(f"{name} needs three numbers, such as [0.1, 0.0, 0.05]")
        most, unit = (2 * math.pi, "rad") if key.endswith("rad") else (_LARGEST_BODY_M, "m")
        if numbers and max(map(abs, numbers)) > most:
            raise IpsysError(f"{name} is {list(numbers)}; give {unit}, at most {most:.3g}")


def check_unique(names: Iterable[object], what: str) -> None:
    seen: set[object] = set()
    for name in names:
        if name in seen:
            raise IpsysError(f"{what} {name!r}; give each its own")
        seen.add(name)
