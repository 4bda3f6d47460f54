"""Poses of free bodies in simulated labs: errors and covariances against the ground truth.

    python benchmarks/bodies.py                                     # all rows, 16 labs each: 40 minutes
    python benchmarks/bodies.py --row "one marker" --labs 600:604

Three cameras of 1920 x 1080 px with a rolling shutter of 31 us a row, 2.1 m above the floor, out of step by
11 and 22 ms, see a body that is carried: up to 1 m above the floor, with 0.7 m/s in the mean, tilted by up to
30 degrees. Each corner is seen at the exposure of its row. As in ``detect``, the corners of a marker are then
those of one instant, except for its motion out of its plane. Errors of a corner are normal, with 0.02 or 0.06
px. The size of the body has an error of 0.02 %; in the row ``carried``, prints are wrong by 0.1 % and
``calibrate-body`` has found poses and sides from another flight of 20 s in the same lab. A lab is one draw:
the table has the median and the maximum over the labs of the mean and of the 95th percentile. NEES is the
mean of the squared error in units of its covariance, by degree of freedom. ``frames`` are poses by one image;
their NEES covers the position.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from geometric_labs import Scene, fit_session, make_session
from honest_labs import scale_tape
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from ipsys_log.calibration.joint.body_calibration import calibrate_body
from ipsys_log.calibration.joint.payload import joint_payload, restore_joint
from ipsys_log.capture.simulation.cameras import Camera
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import (
    Array,
    Marker,
    Markers,
    Message,
    Model,
    Position,
    Positions,
    Rig,
    RigBody,
    RigCamera,
    RigMarker,
    Track,
    Tracks,
)
from ipsys_log.models.locate_corners import LocateCorners
from ipsys_log.models.tracking.smoothed_poses import Frame, smooth_positions
from ipsys_log.models.tracking.track_messages import make_track
from ipsys_log.stages.fuse import Fuse
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import BodyShape, body_shapes
from ipsys_log.vision.lenses import project
from ipsys_log.vision.poses import make_pose, transform
from tests.geometric.lab import GeometricLab, GeometricSettings

__all__ = ["ROWS", "BodyRow", "fly"]

_ROW_NS, _RATE_HZ, _DELAYS_S = 31_000, 30.0, (0.0, 0.011, 0.022)
_PLATE_M = ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.2, 0.2, 0.0), (0.0, 0.2, 0.0))
_PIVOT_M = (0.05, 0.0, -0.05)
_BORDER_PX, _LEAST_AREA_PX2 = 5, 20.0
_EPOCH_NS = 1_000_000 * NS_PER_S
_CARRY_S = 20.0


@dataclass(frozen=True, slots=True)
class BodyRow:
    """A row of the table: markers of 10 cm, noise, calibration, and which poses count.

    With ``points`` below 75, the calibration has a drive of 120 s. ``print_error`` is the relative error of
    the true size beside the rig; None: drawn. ``overlap``: only poses that two cameras have seen. The
    rig of a ``carried`` body is that of ``calibrate-body``.
    """

    name: str
    markers: int = 4
    sigma_px: float = 0.02
    points: int = 75
    print_error: float | None = None
    overlap: bool = False
    exact_tape: bool = False
    carried: bool = False


ROWS = (
    BodyRow("four markers"),
    BodyRow("four markers, exact tape", exact_tape=True),
    BodyRow("four markers, 0.06 px", sigma_px=0.06),
    BodyRow("four markers, a drive and 4 points", points=4),
    BodyRow("one marker", markers=1),
    BodyRow("two cameras", overlap=True),
    BodyRow("print 0.1 % too small", print_error=-0.001),
    BodyRow("carried", carried=True),
)


@cache
def calibrate(points: int, seed: int, exact_tape: bool) -> tuple[GeometricLab, Model]:
    """Return a lab and its joint calibration; the scale of the tape and the prints are drawn with 0.1 %."""
    drives = points < 75
    settings = GeometricSettings(
        lab=LabSettings(
            rate_hz=10.0, drive_s=120.0 if drives else 0.0, markers=1 if drives else 3, row_time_ns=_ROW_NS
        ),
        points=points,
        frame_delays_s=_DELAYS_S,
        marker_scale_sigma=0.001,
    )
    session = make_session(Scene("bodies", settings), seed)
    if not exact_tape:
        scale = 1 + np.random.default_rng([seed, 33]).normal(0.0, 0.001)
        session = replace(session, messages=tuple(scale_tape(iter(session.messages), scale)))
    return session.lab, joint_payload(fit_session(session), session.pairs, 0)


class Flight:
    """The true motion of a body: splines through random poses."""

    def __init__(self, rng: np.random.Generator, duration_s: float) -> None:
        count = int(duration_s / 0.6) + 4
        points_m = rng.uniform((1.2, 0.8, 0.1), (3.7, 4.0, 1.0), (count, 3))
        for n in range(1, count):
            step_m = points_m[n] - points_m[n - 1]
            points_m[n] = points_m[n - 1] + step_m * min(1.0, 0.45 / float(np.linalg.norm(step_m)))
        tilts = np.radians(30) * rng.uniform(-1, 1, (count, 2)) / np.sqrt(2)
        yaws = np.cumsum(rng.uniform(-0.5, 0.5, (count, 1)), axis=0)
        knots_s = 0.6 * (np.arange(count) - 1)
        self._spline = CubicSpline(knots_s, np.concatenate([points_m, tilts, yaws], axis=1))

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """Return points (n, 3) and rotations (n, 3, 3)."""
        values = self._spline(times_s)
        tilts = np.pad(values[:, 3:5], ((0, 0), (0, 1)))
        yaws = np.pad(values[:, 5:], ((0, 0), (2, 0)))
        return values[:, :3], (Rotation.from_rotvec(yaws) * Rotation.from_rotvec(tilts)).as_matrix()


def _see(camera: Camera, flight: Flight, corners_m: Array, time_s: float) -> tuple[Array, float]:
    """Return the corners (4, 2) of a marker as detect gives them, and the instant of their exposure."""
    row_s, middle_m = _ROW_NS / NS_PER_S, corners_m.mean(axis=0)
    at_s = time_s
    for _ in range(3):
        (point_m,), (turn,) = flight.poses(np.array([at_s]))
        world_m = transform(make_pose(turn, point_m), corners_m)
        pixels = project(transform(camera.camera_from_world, world_m), camera.lens)
        at_s = time_s + float(pixels[:, 1].mean()) * row_s
    # The motion of each corner until its row, without the part in the plane of the marker.
    points_m, turns = flight.poses(time_s + pixels[:, 1] * row_s)
    normal = np.cross(world_m[1] - world_m[0], world_m[0] - world_m[3])
    normal /= np.linalg.norm(normal)
    centre_m = world_m.mean(axis=0)
    moved_m = points_m + turns @ middle_m - centre_m
    turned_rad = Rotation.from_matrix(turns @ turn.T).as_rotvec()
    tilted_rad = turned_rad - np.outer(turned_rad @ normal, normal)
    seen_m = world_m + np.outer(moved_m @ normal, normal) + np.cross(tilted_rad, world_m - centre_m)
    return project(transform(camera.camera_from_world, seen_m), camera.lens), at_s


def _is_visible(pixels: Array, camera: Camera) -> bool:
    limits = np.array([camera.lens.width, camera.lens.height]) - _BORDER_PX
    sides = np.roll(pixels, -1, axis=0) - pixels
    after = np.roll(sides, -1, axis=0)
    areas = sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0]
    return bool((pixels > _BORDER_PX).all() and (pixels < limits).all() and areas.min() > _LEAST_AREA_PX2)


def _frames(
    lab: GeometricLab,
    flight: Flight,
    shape: BodyShape,
    row: BodyRow,
    scale: float,
    duration_s: float,
    seed: int,
) -> Iterator[Message]:
    """Yield the markers of all frames in order of time."""
    rng = np.random.default_rng(seed)
    instants = [
        (n / _RATE_HZ + delay_s, camera)
        for n in range(int(duration_s * _RATE_HZ))
        for camera, delay_s in zip(lab.cameras, _DELAYS_S, strict=True)
    ]
    for time_s, camera in sorted(instants, key=lambda one: one[0]):
        markers = []
        for marker_id, corners_m in shape.corners_m.items():
            pixels, at_s = _see(camera, flight, scale * corners_m, time_s)
            if _is_visible(pixels, camera):
                noisy = pixels + rng.normal(0.0, row.sigma_px, (4, 2))
                covariance = row.sigma_px**2 * np.eye(8)
                markers.append(Marker(marker_id, noisy, covariance, round((at_s - time_s) * NS_PER_S)))
        stamp_ns = _EPOCH_NS + round(time_s * NS_PER_S)
        yield Message(
            "/markers", stamp_ns, stamp_ns, Markers(stamp_ns, tuple(markers), 1920, 1080), camera.name
        )


def _rig(lab: GeometricLab, row: BodyRow, scale_sigma: float) -> Rig:
    markers = tuple(
        RigMarker(20 + n, 0.1, "drone", xyz_m=place_m) for n, place_m in enumerate(_PLATE_M[: row.markers])
    )
    cameras = tuple(RigCamera(camera.name, row_time_ns=_ROW_NS) for camera in lab.cameras)
    body = RigBody("drone", level=False, pivot_m=_PIVOT_M, scale_sigma=scale_sigma)
    return Rig("lab", "DICT_4X4_100", 0.2, markers, cameras, bodies=(body,))


# Errors (n, 6), and covariances (n, 6, 6), or (n, 3, 3) of the points.
Errors = tuple[Array, Array]


def fly(row: BodyRow, seed: int, duration_s: float) -> dict[str, Errors]:
    """Return the errors of the poses of a lab: of single frames, of tracks, and of smoothed tracks."""
    lab, model = calibrate(row.points, seed, row.exact_tape)
    rng = np.random.default_rng(seed)
    sigma = 0.0002 if row.print_error is None else abs(row.print_error)
    drawn = rng.normal(0, 0.001 if row.carried else sigma)
    scale = 1 + (drawn if row.print_error is None else row.print_error)
    rig = _rig(lab, row, sigma)
    (shape,), flight = body_shapes(rig), Flight(rng, duration_s)
    if row.carried:
        carrying = _frames(lab, Flight(rng, _CARRY_S), shape, row, scale, _CARRY_S, seed + 1000)
        unknown = replace(rig, markers=tuple(replace(m, xyz_m=(), rpy_rad=()) for m in rig.markers))
        rig = calibrate_body(restore_joint(model), unknown, "drone", carrying).apply(unknown)
    locate, fuse = LocateCorners(model), Fuse("joint", model)
    for step in (locate, fuse):
        assert not list(step(Message("/rig", 0, 0, rig)))
    frames: list[Frame] = []
    tracks: list[tuple[int, Track]] = []
    for message in _frames(lab, flight, shape, row, scale, duration_s, seed):
        (positions,) = (one for one in locate(message) if isinstance(one, Positions))
        stamp_ns, camera = message.publish_time_ns, str(message.camera)
        frames.append(Frame(stamp_ns, camera, stamp_ns, positions.positions))
        for made in fuse(Message("/positions", stamp_ns, stamp_ns, positions, camera)):
            tracks += [(made.timestamp, one) for one in made.tracks] if isinstance(made, Tracks) else []
    smoothed = [(one.pose.time_ns, make_track(one.pose)) for one in smooth_positions(frames, rig, model)]
    pivot = shape.body_from_pivot
    single = [
        (frame.time_ns + (position.time_offset_ns or 0), position)
        for frame in frames
        for position in frame.positions
    ]
    counted = [(at, one) for at, one in tracks if one.coasting_ns is None]
    if row.overlap:
        counted, smoothed = (
            [(at, one) for at, one in own if len(one.cameras) > 1] for own in (counted, smoothed)
        )
        single = []
    parts = {"frames": _errors(single, flight, np.eye(4)), "tracks": _errors(counted, flight, pivot)}
    return {**parts, "smoothed": _errors(smoothed, flight, pivot)}


def _errors(rows: Sequence[tuple[int, Any]], flight: Flight, pivot: Array) -> Errors:
    """Return the errors of poses of a pivot (4, 4) of the body, and their covariances."""
    times_s = np.array([at - _EPOCH_NS for at, _ in rows]) / NS_PER_S
    points_m, turns = flight.poses(times_s) if len(rows) else (np.zeros((0, 3)), np.zeros((0, 3, 3)))
    true_m, turns = points_m + turns @ pivot[:3, 3], turns @ pivot[:3, :3]
    found_m = np.array([(one.x_m, one.y_m, one.z_m) for _, one in rows]).reshape(-1, 3)
    found = Rotation.from_rotvec(np.array([one.rotation_rad for _, one in rows]).reshape(-1, 3))
    turned_rad = (found * Rotation.from_matrix(turns.reshape(-1, 3, 3)).inv()).as_rotvec()
    return np.concatenate([found_m - true_m, turned_rad], axis=1), np.array(
        [_covariance(one) for _, one in rows]
    )


def _covariance(one: Track | Position) -> Array:
    """Return the covariance (6, 6) of a track; of a single position (3, 3), because it states no other."""
    covariance = one.pose_covariance if isinstance(one, Track) else one.covariance_m2
    assert covariance is not None
    return covariance


def _score(errors: Errors) -> dict[str, float]:
    """Return the figures of one lab."""
    away_mm = 1e3 * np.linalg.norm(errors[0][:, :3], axis=1)
    turned_deg = np.degrees(np.linalg.norm(errors[0][:, 3:], axis=1))
    size = errors[1].shape[1]
    stated = errors[0][:, :size]
    solved = np.linalg.solve(errors[1], stated[:, :, None])[:, :, 0]
    return {
        "poses": len(away_mm),
        "mean mm": float(away_mm.mean()),
        "p95 mm": float(np.percentile(away_mm, 95)),
        "z mm": float(np.median(np.abs(1e3 * errors[0][:, 2]))),
        "mean deg": float(turned_deg.mean()),
        "p95 deg": float(np.percentile(turned_deg, 95)),
        "NEES": float((stated * solved).sum(axis=1).mean() / size),
        "over 5 deg": int((turned_deg > 5).sum()),
    }


def measure(row: BodyRow, seeds: Sequence[int], duration_s: float) -> dict[str, dict[str, list[float]]]:
    """Return the figures of all labs by kind of pose."""
    table: dict[str, dict[str, list[float]]] = {}
    for seed in seeds:
        for kind, errors in fly(row, seed, duration_s).items():
            if len(errors[0]):
                for name, value in _score(errors).items():
                    table.setdefault(kind, {}).setdefault(name, []).append(value)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--labs", default="600:616", help="seeds, first:end")
    parser.add_argument("--row", action="append", help="a part of the name of a row")
    parser.add_argument("--seconds", type=float, default=8.0, help="duration of a flight")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    first, end = map(int, options.labs.split(":"))
    rows = [row for row in ROWS if not options.row or any(re.match(part, row.name) for part in options.row)]
    results = {}
    heads = "".join(f"{head:>13}" for head in ("mean mm", "p95 mm", "mean deg", "p95 deg", "NEES"))
    print(f"{'median / largest of the labs':<44}{heads}")
    for row in rows:
        with threadpool_limits(1):
            results[row.name] = table = measure(row, range(first, end), options.seconds)
        for kind, own in table.items():
            columns = [
                f"{np.median(own[name]):.{digits}f}/{max(own[name]):.{digits}f}"
                for name, digits in (("mean mm", 2), ("p95 mm", 2), ("mean deg", 3), ("p95 deg", 3))
            ]
            nees = f"{np.mean(own['NEES']):.2f}/{max(own['NEES']):.2f}"
            mirrored = f"  {sum(own['over 5 deg']):.0f} of {sum(own['poses']):.0f} beyond 5 degrees"
            line = "".join(f"{one:>13}" for one in (*columns, nees))
            print(f"{row.name + ', ' + kind:<44}{line}{mirrored if row.markers == 1 else ''}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
