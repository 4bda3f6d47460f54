"""Messages of a simulated session without images: rig, calibrations, markers, measurements, ground truth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.lenses import project
from ipsys_log.geometry.poses import transform
from ipsys_log.messages import (
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    TRUTH_TOPIC,
    Interval,
    Marker,
    Markers,
    Measurement,
    Message,
    Rig,
    Run,
    Track,
    Tracks,
    calibration_topic,
)
from ipsys_log.messages.channels import MARKERS, RECORD
from ipsys_log.simulation.calibration_points import SimulatedPose, measure
from ipsys_log.simulation.cameras import Camera, sees
from ipsys_log.simulation.corner_noise import corner_covariances, draw_corner_noise, edge_sigma_px
from ipsys_log.simulation.geometric_lab import GeometricLab, PlacedMarkers, camera_poses
from ipsys_log.simulation.lab import EPOCH_NS, build_rig
from ipsys_log.simulation.settings import Purpose, random_stream
from ipsys_log.units import NS_PER_S

__all__ = ["MARKERS_RUN", "CameraSightings", "geometric_rig", "simulate_session", "simulate_sightings"]

Array = NDArray[np.float64]
Times = NDArray[np.int64]

MARKERS_RUN = "geometric"
_PAUSE_NS = 3 * NS_PER_S
# From the end of a frame to its arrival, and from the last frame at a point to the end of its measurement.
_LATENCY_NS, _MEASURED_NS = 50_000_000, 200_000_000
# A marker is stationary for longer than its frames, so a stationary interval holds for all clocks.
_STILL_MARGIN_NS = 100_000_000
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


def geometric_rig(lab: GeometricLab) -> Rig:
    """Return the rig that the user has."""
    rig = build_rig(lab.settings.lab)
    if lab.settings.row_time_in_rig:
        return rig
    return replace(rig, cameras=tuple(replace(camera, row_time_ns=None) for camera in rig.cameras))


def simulate_session(lab: GeometricLab) -> Iterator[Message]:
    """Yield the messages of a session, in log order.

    Equal labs give equal messages. Markers belong to the run ``geometric`` of the stage ``import``, like the
    markers of other programs.

    Examples
    --------
    >>> from ipsys_log.simulation.geometric_lab import GeometricSettings, build_lab
    >>> messages = list(simulate_session(build_lab(GeometricSettings(points=3))))
    >>> [message.topic for message in messages][:2]
    ['/rig', '/cameras/red/calibration']
    """
    rows = [*_head(lab), *_markers(lab), *_truth(lab), *_measured(lab)]
    rows.sort(key=lambda row: row[0])
    log_time_ns = EPOCH_NS
    for arrival_ns, topic, payload, publish_ns, camera in rows:
        log_time_ns = max(arrival_ns, log_time_ns + 1)
        yield Message(topic, log_time_ns, publish_ns, payload, camera)
    run = Run(publish_ns, MARKERS_RUN, "import", {"format": "geometric_lab"})
    yield Message(RECORD.topic_of(MARKERS_RUN), log_time_ns + 1, publish_ns, run)


_Row = tuple[int, str, Any, int, str | None]


def _head(lab: GeometricLab) -> Iterator[_Row]:
    yield EPOCH_NS, RIG_TOPIC, geometric_rig(lab), EPOCH_NS, None
    for name, lens in lab.calibrations.items():
        yield EPOCH_NS, calibration_topic(name), replace(lens, timestamp=EPOCH_NS), EPOCH_NS, name


def _markers(lab: GeometricLab) -> Iterator[_Row]:
    width, height = lab.settings.lab.width, lab.settings.lab.height
    for camera in lab.cameras:
        sightings, topic = simulate_sightings(lab, camera), MARKERS.topic_of(MARKERS_RUN, camera.name)
        timed = lab.settings.row_time_in_rig and lab.settings.lab.row_time_ns > 0
        by_frame: dict[int, list[Marker]] = defaultdict(list)
        for stamp_ns in _stamps(lab, camera).tolist():
            by_frame[stamp_ns] = []
        rows = zip(
            sightings.stamps_ns.tolist(),
            sightings.ids.tolist(),
            sightings.corners_px,
            sightings.covariances_px2,
            sightings.offsets_ns.tolist(),
            strict=True,
        )
        for stamp_ns, marker_id, corners_px, covariance_px2, offset_ns in rows:
            marker = Marker(marker_id, corners_px, covariance_px2, offset_ns if timed else None)
            by_frame[stamp_ns].append(marker)
        for stamp_ns, markers in by_frame.items():
            markers.sort(key=lambda marker: marker.id)
            frame = Markers(stamp_ns, tuple(markers), width, height)
            yield stamp_ns + _LATENCY_NS, topic, frame, stamp_ns, camera.name


def _stamps(lab: GeometricLab, camera: Camera) -> Times:
    instants = [*(_still_times(lab, n) for n in range(len(lab.points))), _drive_times(lab)]
    delay_ns, offset_ns = lab.frame_delays_ns[camera.name], lab.clock_offsets_ns[camera.name]
    return np.asarray(np.concatenate(instants) + delay_ns + offset_ns, dtype=np.int64)


def _truth(lab: GeometricLab) -> Iterator[_Row]:
    for number, poses in enumerate(lab.points):
        placed = lab.place(_as_array(poses))
        for time_ns in _still_times(lab, number).tolist():
            yield _tracks(time_ns, [(pose.marker_id, placed, n) for n, pose in enumerate(poses)])
    times_ns = _drive_times(lab)
    since_s = (times_ns - _start_ns(lab, len(lab.points))) / NS_PER_S
    robots = {marker_id: lab.drive_poses(marker_id, since_s) for marker_id in lab.drive.ahead_s}
    for n, time_ns in enumerate(times_ns.tolist()):
        yield _tracks(time_ns, [(marker_id, placed, n) for marker_id, placed in robots.items()])


def _tracks(time_ns: int, robots: list[tuple[int, PlacedMarkers, int]]) -> _Row:
    tracks = []
    for marker_id, placed, n in robots:
        (x_m, y_m, z_m), side = placed.centres_m[n].tolist(), placed.rotations[n, :, 1]
        heading_rad = float(np.arctan2(side[1], side[0]))
        tracks.append(Track(f"robot_{marker_id}", marker_id, x_m, y_m, z_m, heading_rad))
    return time_ns, TRUTH_TOPIC, Tracks(time_ns, tuple(tracks)), time_ns, None


def _measured(lab: GeometricLab) -> Iterator[_Row]:
    index = 0
    for number, poses in enumerate(lab.points):
        times_ns = _still_times(lab, number).tolist()
        for pose in poses:
            splits = ("train",) if index < lab.settings.points else ("test",)
            measurement = _measurement(lab, pose, index, times_ns, splits)
            index += 1
            yield (
                times_ns[-1] + _MEASURED_NS,
                MEASUREMENTS_TOPIC,
                measurement,
                measurement.timestamp,
                None,
            )


def _measurement(
    lab: GeometricLab, pose: SimulatedPose, index: int, times_ns: list[int], splits: tuple[str, ...]
) -> Measurement:
    measured = measure(pose, lab.settings.lab, index, times_ns, splits)
    # The session has clock offsets and delays: an interval without them would miss frames.
    first_ns, last_ns = times_ns[0] - _STILL_MARGIN_NS, times_ns[-1] + _STILL_MARGIN_NS
    return replace(measured, still=Interval(first_ns, last_ns))


def simulate_sightings(lab: GeometricLab, camera: Camera) -> CameraSightings:
    """Return all sightings of a camera: those at the calibration points, and those of the drive.

    Parameters
    ----------
    lab : from :func:`~ipsys_log.simulation.geometric_lab.build_lab`.
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
        times_ns = _still_times(lab, number) + lab.frame_delays_ns[camera.name]
        count = len(times_ns)
        placed = lab.place(np.repeat(_as_array(poses), count, axis=0))
        ids = np.repeat([pose.marker_id for pose in poses], count)
        placements = np.repeat(np.arange(index, index + len(poses)), count)
        corners_m = placed.corners_m(np.array([lab.sides_m[n] for n in ids.tolist()]))
        yield _Part(np.tile(times_ns, len(poses)), ids, placements, placed, corners_m)
        index += len(poses)


def _drive_parts(lab: GeometricLab, camera: Camera) -> Iterator[_Part]:
    frames_ns = _drive_times(lab) + lab.frame_delays_ns[camera.name]
    since_s = (frames_ns - _start_ns(lab, len(lab.points))) / NS_PER_S
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


def _as_array(poses: tuple[SimulatedPose, ...]) -> Array:
    return np.array([(pose.x_m, pose.y_m, pose.z_m, pose.heading_rad) for pose in poses])


def _start_ns(lab: GeometricLab, number: int) -> int:
    """Return the first time of a set of calibration points; after the last set, the start of the drive."""
    settings = lab.settings.lab
    still_ns = round((settings.frames_per_station - 1) * NS_PER_S / settings.rate_hz)
    return EPOCH_NS + NS_PER_S + number * (still_ns + _PAUSE_NS)


def _still_times(lab: GeometricLab, number: int) -> Times:
    return _times(lab, _start_ns(lab, number), lab.settings.lab.frames_per_station)


def _drive_times(lab: GeometricLab) -> Times:
    settings = lab.settings.lab
    return _times(lab, _start_ns(lab, len(lab.points)), round(settings.drive_s * settings.rate_hz))


def _times(lab: GeometricLab, start_ns: int, count: int) -> Times:
    steps = np.rint(np.arange(count) * NS_PER_S / lab.settings.lab.rate_hz)
    return start_ns + steps.astype(np.int64)
