"""The newest poses of the robots and their trails, as JSON."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from ipsys_log.messages import Rig, Track, Tracks
from ipsys_log.messages.message import Mat33
from ipsys_log.report.styles import robot_colour, shorten
from ipsys_log.units import NS_PER_S

_NS_PER_MS = 1_000_000
# Duration of a trail, and the least time between two of its points.
_TRAIL_NS, _TRAIL_STEP_NS = 10 * NS_PER_S, NS_PER_S // 10
# A robot that no track mentions for so long is left out.
_GONE_NS = 60 * NS_PER_S
# A log may name any number of robots; more do not fit on a page.
_MOST_ROBOTS = 200
# The 95 % quantile of the chi-squared distribution with two degrees of freedom, and its square root.
_SCALE_95 = math.sqrt(5.991464547107979)
_DECIMALS = 4  # of m and rad


def ellipse_of(covariance_m2: Mat33) -> tuple[float, float, float] | None:
    """Return the ellipse in x and y that contains a position with a probability of 95 %.

    Parameters
    ----------
    covariance_m2 : (3, 3), covariance of a position.

    Returns
    -------
    Long and short semi-axis in m, and the angle from x to the long one in rad; None if an entry is no number.

    Examples
    --------
    >>> import numpy as np
    >>> [round(value, 3) for value in ellipse_of(np.diag([4e-4, 1e-4, 9.0]))]
    [0.049, 0.024, 0.0]
    """
    xx, xy, yy = float(covariance_m2[0, 0]), float(covariance_m2[0, 1]), float(covariance_m2[1, 1])
    middle, radius = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    if not math.isfinite(middle + radius):
        return None
    long_m, short_m = (_SCALE_95 * math.sqrt(max(value, 0.0)) for value in (middle + radius, middle - radius))
    return long_m, short_m, math.atan2(2 * xy, xx - yy) / 2


class Robots:
    """The newest poses of the robots. Times of the JSON are in ms since ``begin_ns``.

    Parameters
    ----------
    rig : its named robots are announced; other markers are shown as less important. None: all are important.
    begin_ns : time 0 of the page.

    Attributes
    ----------
    version : increases with each message.
    """

    def __init__(self, rig: Rig | None, begin_ns: int) -> None:
        self.version = 0
        self._begin_ns = begin_ns
        named = [] if rig is None else list(rig.robot_heights_m())
        self._named = frozenset(named)
        self._rows: dict[str, tuple[int, dict[str, Any]]] = {}
        self._trails: dict[str, deque[tuple[int, float, float]]] = {}
        self._colours = {name: robot_colour(number) for number, name in enumerate(named)}

    def add(self, tracks: Tracks) -> None:
        """Handle the tracks of one instant."""
        for track in tracks.tracks:
            before = self._rows.get(track.robot)
            is_known = before is not None or len(self._rows) < _MOST_ROBOTS
            is_late = before is not None and before[0] > tracks.timestamp
            if is_known and not is_late and math.isfinite(track.x_m) and math.isfinite(track.y_m):
                self._rows[track.robot] = tracks.timestamp, self._row(track, tracks.timestamp)
                self._extend_trail(track, tracks.timestamp)
        self.version += 1

    def forget(self) -> None:
        """Forget all poses: a playback begins again."""
        self._rows.clear()
        self._trails.clear()
        self.version += 1

    def rows(self, now_ns: int) -> list[dict[str, Any]]:
        """Return a row for each robot; a missing value is a missing key."""
        for robot in [name for name, (time_ns, _) in self._rows.items() if now_ns - time_ns > _GONE_NS]:
            del self._rows[robot], self._trails[robot]
        return [row for _, row in self._rows.values()]

    def trails(self) -> Mapping[str, list[tuple[int, float, float]]]:
        """Return by robot the points (time in ms, x, y) of its trail, the oldest first."""
        return {robot: list(points) for robot, points in self._trails.items()}

    def _row(self, track: Track, time_ns: int) -> dict[str, Any]:
        seen_ns = time_ns - (track.coasting_ns or 0)
        row: dict[str, Any] = {
            "name": shorten(track.robot),
            "id": track.id,
            "t": (time_ns - self._begin_ns) // _NS_PER_MS,
            "seen": (seen_ns - self._begin_ns) // _NS_PER_MS,
            "x": round(track.x_m, _DECIMALS),
            "y": round(track.y_m, _DECIMALS),
            "cameras": track.cameras,
        }
        if not self._named or track.robot in self._named:
            row["colour"] = self._colours.setdefault(track.robot, robot_colour(len(self._colours)))
        if track.heading_rad is not None and math.isfinite(track.heading_rad):
            row["heading"] = round(track.heading_rad, _DECIMALS)
        ellipse = None if track.covariance_m2 is None else ellipse_of(track.covariance_m2)
        if ellipse is not None:
            row["ellipse"] = [round(value, _DECIMALS + 1) for value in ellipse]
        if track.inside is False:
            row["outside"] = True
        return row

    def _extend_trail(self, track: Track, time_ns: int) -> None:
        trail = self._trails.setdefault(track.robot, deque())
        time_ms = (time_ns - self._begin_ns) // _NS_PER_MS
        if trail and (time_ms - trail[-1][0]) * _NS_PER_MS < _TRAIL_STEP_NS:
            return
        trail.append((time_ms, round(track.x_m, _DECIMALS), round(track.y_m, _DECIMALS)))
        while (time_ms - trail[0][0]) * _NS_PER_MS > _TRAIL_NS:
            trail.popleft()
