"""Messages of a simulated session without images: rig, calibrations, markers, measurements, ground truth."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ipsys_log.capture.simulation.calibration_points import SimulatedPose, measure
from ipsys_log.capture.simulation.cameras import Camera
from ipsys_log.capture.simulation.lab import EPOCH_NS, ROBOT_HEIGHT_SIGMA_M, build_rig
from ipsys_log.messages import (
    IMPORTED,
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
    Times,
    Track,
    Tracks,
    calibration_topic,
)
from ipsys_log.messages.channels import MARKERS, RECORD
from ipsys_log.units import NS_PER_S
from tests.geometric.lab import GeometricLab, PlacedMarkers
from tests.geometric.sightings import drive_times_ns, pose_array, simulate_sightings, start_ns, still_times_ns

MARKERS_RUN = "geometric"
# From the end of a frame to its arrival, and from the last frame at a point to the end of its measurement.
_LATENCY_NS, _MEASURED_NS = 50_000_000, 200_000_000
# A marker is stationary for longer than its frames, so a stationary interval holds for all clocks.
_STILL_MARGIN_NS = 100_000_000


def geometric_rig(lab: GeometricLab) -> Rig:
    """Return the rig that the user has."""
    sigma_m = max(lab.settings.robot_height_sigma_m, ROBOT_HEIGHT_SIGMA_M)
    rig = replace(build_rig(lab.settings.lab), marker_height_sigma_m=sigma_m)
    if lab.settings.row_time_in_rig:
        return rig
    return replace(rig, cameras=tuple(replace(camera, row_time_ns=None) for camera in rig.cameras))


def simulate_session(lab: GeometricLab) -> Iterator[Message]:
    """Yield the messages of a session, in log order.

    Equal labs give equal messages. Markers belong to the run ``geometric`` of the stage ``import``, like the
    markers of other programs.

    Examples
    --------
    >>> from tests.geometric.lab import GeometricSettings, build_lab
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
    run = Run(publish_ns, MARKERS_RUN, IMPORTED, {"format": "geometric_lab"})
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
    instants = [*(still_times_ns(lab, n) for n in range(len(lab.points))), drive_times_ns(lab)]
    delay_ns, offset_ns = lab.frame_delays_ns[camera.name], lab.clock_offsets_ns[camera.name]
    return np.asarray(np.concatenate(instants) + delay_ns + offset_ns, dtype=np.int64)


def _truth(lab: GeometricLab) -> Iterator[_Row]:
    for number, poses in enumerate(lab.points):
        placed = lab.place(pose_array(poses))
        for time_ns in still_times_ns(lab, number).tolist():
            yield _tracks(time_ns, [(pose.marker_id, placed, n) for n, pose in enumerate(poses)])
    times_ns = drive_times_ns(lab)
    since_s = (times_ns - start_ns(lab, len(lab.points))) / NS_PER_S
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
        times_ns = still_times_ns(lab, number).tolist()
        for pose in poses:
            splits = ("train",) if index < lab.settings.points else ("test",)
            measurement = _measurement(lab, pose, index, times_ns, splits)
            index += 1
            yield (times_ns[-1] + _MEASURED_NS, MEASUREMENTS_TOPIC, measurement, measurement.timestamp, None)


def _measurement(
    lab: GeometricLab, pose: SimulatedPose, index: int, times_ns: list[int], splits: tuple[str, ...]
) -> Measurement:
    measured = measure(pose, lab.settings.lab, index, times_ns, splits)
    # The session has clock offsets and delays: an interval without them would miss frames.
    first_ns, last_ns = times_ns[0] - _STILL_MARGIN_NS, times_ns[-1] + _STILL_MARGIN_NS
    return replace(measured, still=Interval(first_ns, last_ns))
