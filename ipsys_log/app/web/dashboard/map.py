"""The map of the dashboard: the floor with its cameras, and the robots with their trails."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from ipsys_log.app.report.styles import camera_styles, robot_colour, shorten
from ipsys_log.messages import Array, CameraCalibration, Model, Rig, Track, Tracks
from ipsys_log.sinks.video.floor_map import covariance_ellipse
from ipsys_log.statistics.floor_cameras import outline_view, read_floor_cameras
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import track_tilt_rad

_FLOOR_DECIMALS = 3  # of m
# Margin of the map around its content, without a known floor.
_MARGIN_M = 0.5
_NS_PER_MS = 1_000_000
# Duration of a trail, and the least time between two of its points.
_TRAIL_NS, _TRAIL_STEP_NS = 10 * NS_PER_S, NS_PER_S // 10
# A robot that no track mentions for so long is left out.
_GONE_NS = 60 * NS_PER_S
# A log may name any number of robots; more do not fit on a page.
_MOST_ROBOTS = 200
_DECIMALS = 4  # of m and rad


def describe_floor(rig: Rig | None, model: Model | None, lenses: Mapping[str, CameraCalibration]) -> Any:
    """Return the constant content of the map as JSON.

    It has the size of the lab, its reference points, the field of view of each camera on the floor, and the
    hull of the calibration points, in m.

    Parameters
    ----------
    rig : None if the log has none.
    model : the fitted model; None without one. Its calibration points give the poses of the cameras.
    lenses : intrinsics by camera.
    """
    cameras = {} if model is None else read_floor_cameras(model, lenses)
    colours = camera_styles(lenses)
    outlines = {name: outline_view(camera) for name, camera in cameras.items()}
    measured = _hull(_measured_points(model))
    references = () if rig is None else rig.reference_points
    points_m = [np.array([[point.x_m, point.y_m] for point in references]).reshape(-1, 2), measured]
    return {
        "lab": "" if rig is None else shorten(rig.name),
        "bounds": _bounds(rig, points_m, [*outlines.values()]),
        "has_floor": rig is not None and rig.floor is not None,
        "references": [{"name": shorten(point.name), "x": point.x_m, "y": point.y_m} for point in references],
        "views": [
            {"camera": name, "colour": colours[name][0], "outline": _rounded(outline)}
            for name, outline in sorted(outlines.items())
            if len(outline)
        ],
        "measured": _rounded(measured),
    }


def _measured_points(model: Model | None) -> Array:
    cameras = () if model is None else model.cameras
    points_m = [pair.world_m[:2] for camera in cameras for pair in camera.pairs]
    return np.array([point for point in points_m if np.isfinite(point).all()]).reshape(-1, 2)


def _hull(points_m: Array) -> Array:
    """Return the convex hull (k, 2) of points (n, 2); empty for fewer than three."""
    if len(points_m) < 3:
        return np.zeros((0, 2))
    return np.asarray(cv2.convexHull(points_m.astype(np.float32)).reshape(-1, 2), dtype=np.float64)


def _bounds(rig: Rig | None, points_m: list[Array], outlines_m: list[Array]) -> list[float]:
    """Return the lower and the upper corner of the map: the floor, or all that is known."""
    if rig is not None and rig.floor is not None:
        return [0.0, 0.0, rig.floor.width_m, rig.floor.depth_m]
    known = np.concatenate([*points_m, *outlines_m])
    if not len(known):
        known = np.array([[0.0, 0.0], [4.0, 3.0]])
    low_m, high_m = known.min(axis=0) - _MARGIN_M, known.max(axis=0) + _MARGIN_M
    return [round(float(value), _FLOOR_DECIMALS) for value in (*low_m, *high_m)]


def _rounded(points_m: Array) -> Any:
    return points_m.round(_FLOOR_DECIMALS).tolist()


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
        if track.rotation_rad is not None and math.isfinite(tilt_rad := track_tilt_rad(track)):
            row |= {"z": round(track.z_m, _DECIMALS), "tilt": round(tilt_rad, _DECIMALS)}
        if track.covariance_m2 is not None and np.isfinite(track.covariance_m2[:2, :2]).all():
            ellipse = covariance_ellipse(track.covariance_m2[:2, :2])
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
