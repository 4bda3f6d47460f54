"""Values of a rig file that are numbers of the right kind in the wrong unit."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Rig

__all__ = ["check_slips", "dictionary_size"]


class _Kind(NamedTuple):
    """Within what a value lies in any lab, in its unit, and the units it is mistaken for, as factors."""

    unit: str
    low: float
    high: float
    others: tuple[tuple[str, float], ...] = ()


_LENGTHS = (("cm", 0.01), ("mm", 0.001))
# By the key in the rig file. What is beyond was written in another unit; a row time of 0 is allowed, too.
_KINDS = {
    "marker_length_m": _Kind("m", 0.002, 2.0, _LENGTHS),
    "length_m": _Kind("m", 0.002, 2.0, _LENGTHS),
    "tape_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "width_m": _Kind("m", 0.0, 100.0, _LENGTHS),
    "depth_m": _Kind("m", 0.0, 100.0, _LENGTHS),
    "x_m": _Kind("m", -100.0, 100.0, _LENGTHS),
    "y_m": _Kind("m", -100.0, 100.0, _LENGTHS),
    "rate_hz": _Kind("Hz", 0.0, 1000.0),
    "exposure_s": _Kind("s", 0.0, 1.0, (("ms", 1e-3), ("us", 1e-6))),
    "row_time_ns": _Kind("ns", 1000, 1_000_000, (("us", 1e3),)),
    "edge_offset_px": _Kind("px", -5.0, 5.0),
}

# How many markers a dictionary has, where its name does not say it.
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


def check_slips(rig: Rig, where: str) -> None:
    """See that no value of a rig file is in another unit than it says, and that its markers exist.

    Raises
    ------
    IpsysError
        For a value that no lab has, with what was probably meant, and for a marker id that the dictionary
        does not have.
    """
    for item, key, value in _given(rig):
        kind = _KINDS[key]
        if kind.low <= value <= kind.high:
            continue
        meant = [(unit, value * factor) for unit, factor in kind.others]
        likely = [f"{it:g} if that is {unit}" for unit, it in meant if kind.low <= it <= kind.high]
        then = " or ".join(likely) or f"{kind.low:g} to {kind.high:g}"
        raise IpsysError(f"{where}: {item}{key} = {value:g} is too {_far(value, kind)}; write {then}")
    size = dictionary_size(rig.dictionary)
    for marker in rig.markers:
        if size is not None and marker.id >= size:
            raise IpsysError(
                f"{where}: marker id {marker.id}: {rig.dictionary} has only 0 to {size - 1}; write the id "
                "that is printed, or the dictionary that it was printed from"
            )


def _far(value: float, kind: _Kind) -> str:
    """What is wrong with a value, said of its unit."""
    return f"much for {kind.unit}" if value > kind.high else f"little for {kind.unit}"


def dictionary_size(dictionary: str) -> int | None:
    """How many markers a dictionary of OpenCV has; None for an unknown one.

    Examples
    --------
    >>> dictionary_size("DICT_4X4_100"), dictionary_size("DICT_APRILTAG_16h5")
    (100, 30)
    """
    named = re.fullmatch(r"DICT_\dX\d_(\d+)", dictionary)
    return int(named[1]) if named else _SIZES.get(dictionary)


def _given(rig: Rig) -> Iterator[tuple[str, str, float]]:
    """What has a kind: of which item of the rig it is, its key, and the value."""
    items: list[tuple[str, object]] = [("", rig), *((f"marker {one.id}: ", one) for one in rig.markers)]
    items += [("[floor] ", rig.floor)]
    items += [(f"reference point {one.name}: ", one) for one in rig.reference_points]
    items += [(f"camera {one.name}: ", one) for one in rig.cameras]
    for name, item in items:
        for key in _KINDS:
            value = getattr(item, key, None)
            if value is not None and not (key == "row_time_ns" and value == 0):
                yield name, key, value
