"""Sightings of a session without images: true corners, corners with noise, and their times."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.calibration_points import SimulatedPose
from ipsys_log.capture.simulation.cameras import Camera, sees
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.capture.simulation.settings import Purpose, random_stream
from ipsys_log.messages import Array, Times
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import project
from ipsys_log.vision.poses import transform
from tests.geometric.corner_noise import corner_covariances, draw_corner_noise, edge_sigma_px
from tests.geometric.lab import GeometricLab, PlacedMarkers, camera_poses

# Pause of the recording, for the transport of the markers to their next calibration points.
_PAUSE_NS = 3 * NS_PER_S
# ``detect`` misses markers with smaller cells than this.
_LEAST_CELL_PX = 3.0
# In rendered labs, it detects every marker if a square of this multiple of its side is in the image.
_SEEN_SIDES = 1.03
_CELLS = 6


@dataclass(frozen=True, slots=True, eq=False)
class CameraSightings:
    """The sightings of markers by one camera, in order of time.

    Attributes
    ----------
    camera : its name.
    stamps_ns, times_ns : (n,), time of the frame by the camera's clock, and true time of the exposure.
    offsets_ns : (n,), time offset of the marker within its frame (rolling shutter).
    ids : (n,), marker ids.
    true_px, corners_px : (n, 4, 2), without and with noise.
    covariances_px2 : (n, 8, 8), stated, in single precision.
    centres_m : (n, 3), true centre of the marker at its exposure.
    placements : (n,), number of the calibration point, or of a frame of the drive.
    """

    camera: str
    stamps_ns: Times
    times_ns: Times
    offsets_ns: Times
    ids: Times
    true_px: Array
    corners_px: Array
    covariances_px2: Array
    centres_m: Array
    placements: Times


def simulate_sightings(lab: GeometricLab, camera: Camera) -> CameraSightings:
    """Return all sightings of a camera: those at the calibration points, and those of the drive.

    Parameters
    ----------
    lab : from :func:`~tests.geometric.lab.build_lab`.
    camera : one of its cameras.
    """
    settings, parts = lab.settings.lab, [*_still_parts(lab, camera), *_drive_parts(lab, camera)]
    everything = _Part.join(parts)
    seen = everything.select(_visible(camera, everything, _SEEN_SIDES * settings.marker_length_m))
    seen = seen.select(np.lexsort((seen.ids, seen.frames_ns)))
    true_px = _project(camera, seen.corners_m)
    large = _cell_px(true_px) >= _LEAST_CELL_PX
    seen, true_px = seen.select(large), true_px[large]
    rotations, centres_m = camera_poses(camera, seen.placed)
    sigma_px = edge_sigma_px(settings)
    covariances = corner_covariances(camera.lens, rotations, centres_m, settings.marker_length_m, sigma_px)
    covariances_px2 = covariances.astype(np.float32).astype(np.float64)
    number = [other.name for other in lab.cameras].index(camera.name)
    rng = random_stream(settings.seed, Purpose.CORNERS, number)
    noise_px = draw_corner_noise(covariances_px2, seen.placements, rng, lab.settings.corner_noise)
    # A stored time offset comes from the noisy corners, as in detect.
    corners_px = true_px + noise_px
    offsets_ns = np.rint(corners_px[..., 1].mean(axis=1) * settings.row_time_ns).astype(np.int64)
    late_ns = np.rint(true_px[..., 1].mean(axis=1) * settings.row_time_ns).astype(np.int64)
    return CameraSightings(
        camera.name,
        seen.frames_ns + lab.clock_offsets_ns[camera.name],
        seen.frames_ns + late_ns,
        offsets_ns,
        seen.ids,
        true_px,
        corners_px,
        covariances_px2,
        seen.placed.centres_m,
        seen.placements,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Markers at the frames of a camera, whether visible or not; ``frames_ns`` are true times."""

    frames_ns: Times
    ids: Times
    placements: Times
    placed: PlacedMarkers
    corners_m: Array

    @classmethod
    def join(cls, parts: list[_Part]) -> _Part:
        return cls(
            np.concatenate([part.frames_ns for part in parts]),
            np.concatenate([part.ids for part in parts]),
            np.concatenate([part.placements for part in parts]),
            PlacedMarkers(
                np.concatenate([part.placed.centres_m for part in parts]),
                np.concatenate([part.placed.rotations for part in parts]),
            ),
            np.concatenate([part.corners_m for part in parts]),
        )

    def select(self, rows: NDArray[Any]) -> _Part:
        placed = PlacedMarkers(self.placed.centres_m[rows], self.placed.rotations[rows])
        return _Part(
            self.frames_ns[rows], self.ids[rows], self.placements[rows], placed, self.corners_m[rows]
        )


def _still_parts(lab: GeometricLab, camera: Camera) -> Iterator[_Part]:
    index = 0
    for number, poses in enumerate(lab.points):
        times_ns = still_times_ns(lab, number) + lab.frame_delays_ns[camera.name]
        count = len(times_ns)
        placed = lab.place(np.repeat(pose_array(poses), count, axis=0))
        ids = np.repeat([pose.marker_id for pose in poses], count)
        placements = np.repeat(np.arange(index, index + len(poses)), count)
        corners_m = placed.corners_m(np.array([lab.sides_m[n] for n in ids.tolist()]))
        yield _Part(np.tile(times_ns, len(poses)), ids, placements, placed, corners_m)
        index += len(poses)


def _drive_parts(lab: GeometricLab, camera: Camera) -> Iterator[_Part]:
    frames_ns = drive_times_ns(lab) + lab.frame_delays_ns[camera.name]
    since_s = (frames_ns - start_ns(lab, len(lab.points))) / NS_PER_S
    count = len(frames_ns)
    first = sum(map(len, lab.points))
    for marker_id in lab.drive.ahead_s:
        times_s = since_s[:, None] + _exposures(lab, camera, marker_id, since_s)
        placed = lab.drive_poses(marker_id, times_s.mean(axis=1))
        corners_m = _corners_at(lab, marker_id, times_s)
        placements = first + np.arange(count)
        yield _Part(frames_ns, np.full(count, marker_id), placements, placed, corners_m)
        first += count


def _exposures(lab: GeometricLab, camera: Camera, marker_id: int, since_s: Array) -> Array:
    """Return the exposure of a marker after that of the first row, (n, 1) in s, or of its corners, (n, 4).

    With a known row time, detect fits the motion: its corners are those at the mean time of the marker.
    Otherwise the image shows each corner at its own time.
    """
    settings, late_s = lab.settings.lab, np.zeros((len(since_s), 1))
    if not settings.row_time_ns:
        return late_s
    # A robot moves by a few pixels during a frame: the last repetition changes less than a nanosecond.
    for _ in range(4):
        rows = _project(camera, _corners_at(lab, marker_id, since_s[:, None] + late_s))[..., 1]
        rows = np.clip(np.nan_to_num(rows), 0, settings.height)
        if lab.settings.row_time_in_rig:
            rows = rows.mean(axis=1, keepdims=True)
        late_s = rows * settings.row_time_ns / NS_PER_S
    return late_s


def _corners_at(lab: GeometricLab, marker_id: int, times_s: Array) -> Array:
    """Return the corners (n, 4, 3) of a robot's marker at times (n, 1), or each at its own time (n, 4)."""
    placed = lab.drive_poses(marker_id, times_s.reshape(-1))
    corners_m = placed.corners_m(lab.sides_m[marker_id])
    own = np.arange(4)
    return corners_m if times_s.shape[1] == 1 else np.asarray(corners_m.reshape(-1, 4, 4, 3)[:, own, own])


def _project(camera: Camera, corners_m: Array) -> Array:
    points_c = transform(camera.camera_from_world, corners_m.reshape(-1, 3))
    return project(points_c, camera.lens).reshape(-1, 4, 2)


def _visible(camera: Camera, part: _Part, side_m: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of the markers around which a square is wholly in the image."""
    corners_m = part.placed.corners_m(side_m)
    return np.asarray(sees(camera, corners_m.reshape(-1, 3)).reshape(-1, 4).all(axis=1))


def _cell_px(corners_px: Array) -> Array:
    """Return the smaller width (n,) of a cell of markers with corners (n, 4, 2)."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    lengths = np.linalg.norm(sides, axis=2)
    area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    smaller: Array = np.minimum(area / lengths.max(axis=1), lengths.min(axis=1)) / _CELLS
    return smaller


def pose_array(poses: tuple[SimulatedPose, ...]) -> Array:
    """Return x, y, height above the floor and heading of markers, (n, 4) in m and rad."""
    return np.array([(pose.x_m, pose.y_m, pose.z_m, pose.heading_rad) for pose in poses])


def start_ns(lab: GeometricLab, number: int) -> int:
    """Return the first time of a set of calibration points; after the last set, the start of the drive."""
    settings = lab.settings.lab
    still_ns = round((settings.frames_per_station - 1) * NS_PER_S / settings.rate_hz)
    return EPOCH_NS + NS_PER_S + number * (still_ns + _PAUSE_NS)


def still_times_ns(lab: GeometricLab, number: int) -> Times:
    """Return the instants of the frames of a set of calibration points, by the number of the set."""
    return _times(lab, start_ns(lab, number), lab.settings.lab.frames_per_station)


def drive_times_ns(lab: GeometricLab) -> Times:
    """Return the instants of the frames of the drive."""
    settings = lab.settings.lab
    return _times(lab, start_ns(lab, len(lab.points)), round(settings.drive_s * settings.rate_hz))


def _times(lab: GeometricLab, start_ns: int, count: int) -> Times:
    steps = np.rint(np.arange(count) * NS_PER_S / lab.settings.lab.rate_hz)
    return start_ns + steps.astype(np.int64)
