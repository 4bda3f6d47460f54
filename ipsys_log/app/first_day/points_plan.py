"""The map of calibration points: measured ones, and places that spread further ones over the floor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipsys_log.live_runs.survey.checks import check_entry
from ipsys_log.live_runs.survey.entry import parse_entry
from ipsys_log.live_runs.survey.sheet import read_sheet
from ipsys_log.messages import Array, Rig
from ipsys_log.units import CM_PER_M

# Places are proposed on a grid of so many points along each side of the floor, away from its edge.
_GRID, _EDGE = 9, 0.15
# The tapes from A and B must cross at this angle or more.
_LEAST_CROSSING_RAD = math.radians(35)
# A point closer than this to a measured one adds little.
_NEAR_M = 0.4


def propose_places(rig: Rig, done_m: Sequence[tuple[float, float]], count: int) -> list[tuple[float, float]]:
    """Return up to ``count`` places (x, y), each far from the measured points and from the others.

    The two tapes cross well at each place. Without a floor or two reference points, there is none.
    """
    if rig.floor is None or len(rig.reference_points) < 2:
        return []
    shares = np.linspace(_EDGE, 1 - _EDGE, _GRID)
    grid_m = np.stack(np.meshgrid(shares * rig.floor.width_m, shares * rig.floor.depth_m), axis=-1)
    return _spread(grid_m.reshape(-1, 2), rig, done_m, count)


def _spread(
    candidates_m: Array, rig: Rig, done_m: Sequence[tuple[float, float]], count: int
) -> list[tuple[float, float]]:
    """Return the candidates (n, 2) that are farthest from the points so far, one after the other."""
    a, b = (np.array([point.x_m, point.y_m]) for point in rig.reference_points[:2])
    to_a, to_b = a - candidates_m, b - candidates_m
    across = np.abs(to_a[:, 0] * to_b[:, 1] - to_a[:, 1] * to_b[:, 0])
    sines = across / np.maximum(np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1), 1e-9)
    good_m = candidates_m[sines >= math.sin(_LEAST_CROSSING_RAD)]
    if not len(good_m):
        good_m = candidates_m
    so_far_m = [*done_m] or [tuple((a + b) / 2)]
    chosen: list[tuple[float, float]] = []
    while len(chosen) < count:
        distances_m = np.linalg.norm(good_m[:, None] - np.array([*so_far_m, *chosen])[None], axis=2).min(
            axis=1
        )
        best = int(distances_m.argmax())
        if distances_m[best] < _NEAR_M:
            break
        chosen.append((float(good_m[best, 0]), float(good_m[best, 1])))
        so_far_m = so_far_m if done_m else []  # the middle of AB only begins the first place
    return chosen


def choose_rows(sheet: Path, rig: Rig, done_m: Sequence[tuple[float, float]], count: int) -> str:
    """Return a sheet with the header and ``count`` of its rows, spread over the floor.

    Rows at measured points are left out.
    """
    rows = read_sheet(sheet, rig, 0)
    checked = [check_entry(*parse_entry(row.typed, rig), rig, None, ()) for row in rows]
    lines = {
        (float(one.point_m[0]), float(one.point_m[1])): row.line
        for row, one in zip(rows, checked, strict=True)
        if one.point_m is not None
    }
    chosen = _spread(np.array(list(lines)), rig, done_m, count)
    text = sheet.read_text(encoding="utf-8-sig").splitlines()
    return "\n".join([text[0], *(text[number - 1] for number in sorted(lines[place] for place in chosen))])


def describe_map(
    rig: Rig, done_m: Sequence[tuple[float, float]], proposed_m: Sequence[tuple[float, float]]
) -> dict[str, Any] | None:
    """Return the map as plain data; a proposed place has its distances to the reference points in cm."""
    if rig.floor is None:
        return None
    references = [{"name": point.name, "x_m": point.x_m, "y_m": point.y_m} for point in rig.reference_points]
    return {
        "floor": [rig.floor.width_m, rig.floor.depth_m],
        "references": references,
        "done": [list(place_m) for place_m in done_m],
        "proposed": [
            {
                "point_m": list(place_m),
                "tapes": {
                    point.name: round(CM_PER_M * math.dist(place_m, (point.x_m, point.y_m)))
                    for point in rig.reference_points
                },
            }
            for place_m in proposed_m
        ],
    }
