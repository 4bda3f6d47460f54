"""Advice on the alignment of cameras: text for the person who adjusts a camera, and JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rich.text import Text

from ipsys_log.app.report.alignment import AlignedLab
from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, cm
from ipsys_log.statistics.alignment import LEVEL_M, Alignment
from ipsys_log.statistics.coverage import FloorCoverage, Overlap, Patch
from ipsys_log.units import CM_PER_M

_GOOD, _BAD = "green", "red"
_LEVEL_CM = f"{LEVEL_M * CM_PER_M:g} cm"
# Smaller turns of a camera are not practical.
_LEAST_DEG = 0.05
_MOST_PATCHES = 4


def advise(alignment: Alignment) -> str:
    """Return the advice on one camera, as text.

    Examples
    --------
    >>> advise(Alignment("red", ()))[:32]
    'put four or more markers on the '
    """
    if len(alignment.floor_markers) < 2:
        count, reason = (
            ("three", "one is not enough")
            if alignment.floor_markers
            else ("four", "none is stationary there")
        )
        return f"put {count} or more markers on the floor, up to the edges of its image: {reason}"
    if alignment.axes == 0:
        return "put its markers further apart, up to the edges of its image"
    if alignment.axes == 1 and alignment.level is None:
        return (
            f"put a marker beside the line of its markers: along this line, the spread is under {_LEVEL_CM}"
        )
    aside = "; the tilt is known only along the line of its markers: put a marker beside the line"
    rest = aside if alignment.axes == 1 else ""
    if alignment.level:
        return f"nothing: the camera is level, its spread is under {_LEVEL_CM}"
    turns = _turns(alignment)
    if alignment.remaining_m is not None and alignment.remaining_m >= LEVEL_M:
        text = (
            f"{turns}, but a spread of {cm(alignment.remaining_m, 1)} cm remains"
            if turns
            else "no turn of the camera corrects the spread"
        )
        return (
            f"{text}: check that the markers are flat on the floor, or repeat the intrinsic calibration{rest}"
        )
    return f"{turns}{rest}"


def _turns(alignment: Alignment) -> str:
    """Return the turns of a camera as text, one direction after the other; empty if both are too small."""
    names = (("right", "left"), ("bottom", "top"))
    parts: list[str] = []
    for turn_rad, (more, less) in zip(alignment.turns_rad, names, strict=True):
        if abs(turn := math.degrees(turn_rad)) >= _LEAST_DEG:
            suffix = "" if parts else " of its image"
            parts.append(f"{abs(turn):.1f} degrees towards the {more if turn_rad > 0 else less}{suffix}")
    shift = _on_floor(alignment)
    return f"turn the camera {' and '.join(parts)}{shift}" if parts else ""


def _on_floor(alignment: Alignment) -> str:
    """Return the shift of the principal point on the floor as text; it is easier to see than an angle."""
    if alignment.height_m is None or alignment.tilt_rad is None:
        return ""
    return f" ({cm(alignment.height_m * math.tan(alignment.tilt_rad), 0)} cm on the floor)"


def alignment_table(lab: AlignedLab) -> Rows:
    """Return a table with one row per camera: green if the spread is under 5 cm, else red."""
    cells: list[list[str | Text]] = []
    for alignment in lab.alignments:
        colour = {None: "", True: _GOOD, False: _BAD}[alignment.level]
        used = len(alignment.floor_markers)
        total = used + len(alignment.raised_markers)
        count = f"{used} of {total}" if alignment.raised_markers else str(total)
        spread, advice = Text(cm(alignment.spread_m, 1), style=colour), Text(advise(alignment), style=colour)
        cells.append([alignment.camera, count, spread, _tilt(alignment), advice])
    columns = ("camera", ">markers", ">spread cm", ">tilt deg", "what to do")
    return Rows("Alignment of the cameras", columns, cells)


def _tilt(one: Alignment) -> str:
    if one.tilt_rad is None or one.sigma_rad is None:
        return "-"
    least = "over " if one.axes == 1 else ""
    return f"{least}{math.degrees(one.tilt_rad):.1f} ± {math.degrees(one.sigma_rad):.1f}"


def coverage_lines(lab: AlignedLab) -> list[tuple[str, bool]]:
    """Return lines on the floor and on neighbouring cameras; True marks a good result."""
    floor = _floor_lines(lab.coverage) if lab.coverage is not None else []
    return floor + [
        _overlap_line(overlap, lab.diagonal_m, lab.coverage is not None) for overlap in lab.overlaps
    ]


def _floor_lines(coverage: FloorCoverage) -> list[tuple[str, bool]]:
    floor_m2 = coverage.floor.width_m * coverage.floor.depth_m
    size = f"a marker of {cm(coverage.diagonal_m / math.sqrt(2), 0)} cm"
    if coverage.height_m:
        size += f", {cm(coverage.height_m, 0)} cm above the floor,"
    return [
        _patch_line(coverage.unseen, floor_m2, "every part of the floor is in an image", "in no image"),
        _patch_line(
            coverage.gaps, floor_m2, f"an image shows all of {size} at every position",
            f"no image shows all of {size} with its centre on",
        ),
    ]  # fmt: skip


def _patch_line(patches: Sequence[Patch], floor_m2: float, good: str, bad: str) -> tuple[str, bool]:
    if not patches:
        return good, True
    total_m2 = sum(patch.area_m2 for patch in patches)
    position = "; ".join(
        f"x {p.low_m[0]:.2f} to {p.high_m[0]:.2f}, y {p.low_m[1]:.2f} to {p.high_m[1]:.2f}"
        for p in patches[:_MOST_PATCHES]
    )
    more = f"; {len(patches) - _MOST_PATCHES} more" if len(patches) > _MOST_PATCHES else ""
    area = f"{total_m2:.2f} m² of the floor ({100 * total_m2 / floor_m2:.2g} %)"
    return (f"{bad} {area}" if " with " in bad else f"{area} are {bad}") + f": {position}{more}", False


def _overlap_line(overlap: Overlap, diagonal_m: float, placed: bool) -> tuple[str, bool]:
    names, (x_m, y_m) = " and ".join(overlap.cameras), overlap.at_m.tolist()
    needed = f"a marker needs {cm(diagonal_m, 0)} cm, its diagonal"
    if overlap.width_m >= diagonal_m:
        return f"{names} overlap by {cm(overlap.width_m, 0)} cm or more. This is enough: {needed}", True
    gap = f"leave a gap of {cm(-overlap.width_m, 0)} cm"
    fault = f"overlap by only {cm(overlap.width_m, 0)} cm" if overlap.width_m > 0 else gap
    end = "neither image shows all of a marker between them"
    position = f", at x {x_m:.2f}, y {y_m:.2f}" if placed else ""
    return f"{names} {fault}{position}: {needed}; {end}", False


def alignment_json(lab: AlignedLab) -> dict[str, Any]:
    """Return the alignment as plain data; None for unknown values."""
    coverage = lab.coverage
    return {
        "run": lab.run,
        "level_below_m": LEVEL_M,
        "cameras": [_camera_json(alignment) for alignment in lab.alignments],
        "coverage": None
        if coverage is None
        else {
            "marker_height_m": coverage.height_m,
            "unseen": plain(coverage.unseen),
            "whole_in_no_picture": plain(coverage.gaps),
        },
        "marker_diagonal_m": lab.diagonal_m,
        "overlaps": [
            {
                "cameras": list(overlap.cameras),
                "width_m": overlap.width_m,
                "at_m": None if coverage is None else overlap.at_m.tolist(),
                "enough": overlap.width_m >= lab.diagonal_m,
            }
            for overlap in lab.overlaps
        ],
        "notes": list(lab.notes),
    }


def _camera_json(one: Alignment) -> dict[str, Any]:
    right_rad, bottom_rad = one.turns_rad if one.down is not None else (None, None)
    return {
        "camera": one.camera,
        "places": len(one.floor_markers),
        "markers": sorted({marker.marker_id for marker in one.floor_markers}),
        "raised": [
            {"marker": marker.marker_id, "above_m": above_m} for marker, above_m in one.raised_markers
        ],
        "spread_m": one.spread_m,
        "spread_after_m": one.remaining_m,
        "level": one.level,
        "tilt_rad": one.tilt_rad,
        "tilt_sigma_rad": one.sigma_rad,
        "look_further_right_rad": right_rad,
        "look_further_down_rad": bottom_rad,
        "known_directions": one.axes,
        "height_m": one.height_m,
        "advice": advise(one),
    }
