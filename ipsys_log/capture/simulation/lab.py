"""Simulated session: rig, camera intrinsics, calibration points, driving robots, and ground truth."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from ipsys_log.capture.simulation import calibration_points
from ipsys_log.capture.simulation.cameras import Camera, FloorView, mount_cameras, prepare_view
from ipsys_log.capture.simulation.drive import Drive, plan_drive
from ipsys_log.capture.simulation.render import encode_jpeg, exposure_interval, render
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.capture.simulation.textured_floor import feet
from ipsys_log.messages import (
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    TRUTH_TOPIC,
    CompressedImage,
    Floor,
    Measurement,
    Message,
    Rig,
    RigCamera,
    RigMarker,
    Track,
    Tracks,
    calibration_topic,
    image_topic,
)
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.markers import MovingMarker, PlacedMarker

# Start of the simulated clock: 2023-11-14 22:13:20 UTC.
EPOCH_NS = 1_700_000_000 * NS_PER_S
# The heights of the robots are exact; a standard deviation must be above 0.
ROBOT_HEIGHT_SIGMA_M = 0.0001
# Pause of the recording, for the transport of the markers to their next calibration points.
_PAUSE_NS = 3 * NS_PER_S
# From the end of the exposure of the last row to the arrival of the frame.
_LATENCY_NS = 4_000_000


@dataclass(frozen=True, slots=True)
class Instant:
    """A time at which all cameras take a frame, with the measurements that follow it.

    ``places`` are the poses of the markers at ``time_ns``, the middle of the exposure of the first row.
    ``prints`` are the markers for the renderer.
    """

    time_ns: int
    places: tuple[calibration_points.SimulatedPose, ...]
    prints: tuple[PlacedMarker | MovingMarker, ...]
    measured: tuple[Measurement, ...] = ()


def simulate(
    settings: LabSettings, progress: Callable[[str, int, int], None] = lambda stage, done, total: None
) -> Iterator[Message]:
    """Yield the messages of a session of the simulated lab, in log order.

    With the same versions of OpenCV and NumPy, equal settings give equal messages, byte for byte. The
    function reads no clock: the simulated clock starts at :data:`EPOCH_NS`.

    Parameters
    ----------
    settings : settings of the lab.
    progress : called with the step (``views`` of the cameras, then ``simulate`` for frames), the number of
        finished items, and the number of all items.

    Yields
    ------
    Message
        The rig; a calibration per camera; then, per instant, the ground truth, a frame per camera and the
        measurements. ``publish_time_ns`` is the time of the instant. For a frame, it is the middle of the
        exposure of its first row.

    Examples
    --------
    >>> lab = LabSettings(width=640, height=360, cameras=("red",), markers=1, stations=1, drive_s=0.0)
    >>> [message.topic for message in simulate(lab)][:4]
    ['/rig', '/cameras/red/calibration', '/truth/tracks', '/cameras/red/image']
    """
    log_time_ns = EPOCH_NS
    latency_ns = _LATENCY_NS + round(exposure_interval(0, settings.height - 1, settings)[1] * NS_PER_S)
    for topic, payload, publish_time_ns, camera in _payloads(settings, progress):
        log_time_ns = max(publish_time_ns + latency_ns, log_time_ns + 1)
        yield Message(topic, log_time_ns, publish_time_ns, payload, camera)


def build_rig(settings: LabSettings) -> Rig:
    """Return the rig of the simulated lab; each marker is on its own robot."""
    return Rig(
        name="simulated_lab" if settings.grid is None else "simulated_hall",
        dictionary=settings.dictionary,
        marker_length_m=settings.marker_length_m,
        markers=tuple(RigMarker(index, robot=f"robot_{index}") for index in range(settings.markers)),
        cameras=tuple(RigCamera(name, row_time_ns=settings.row_time_ns or None) for name in settings.cameras),
        reference_points=calibration_points.reference_points(settings),
        floor=Floor(*settings.floor_m),
        marker_height_m=settings.drive_height_m,
        marker_height_sigma_m=ROBOT_HEIGHT_SIGMA_M,
        tape_sigma_m=settings.tape_sigma_m or None,
    )


def live_cameras(settings: LabSettings) -> tuple[RigCamera, ...]:
    """Return the cameras of the lab for a rig file, each with its source."""
    return tuple(
        RigCamera(name, None, None, f"sim:{name}", settings.width, settings.height, settings.rate_hz)
        for name in settings.cameras
    )


def _payloads(
    settings: LabSettings, progress: Callable[[str, int, int], None]
) -> Iterator[tuple[str, Any, int, str | None]]:
    rig = build_rig(settings)
    cameras = mount_cameras(settings, EPOCH_NS)
    yield RIG_TOPIC, rig, EPOCH_NS, None
    for camera in cameras:
        yield calibration_topic(camera.name), camera.lens, EPOCH_NS, camera.name
    with ThreadPoolExecutor(len(cameras)) as pool:
        progress("views", 0, len(cameras))
        views = []
        for view in pool.map(lambda camera: prepare_view(camera, settings), cameras):
            views.append(view)
            progress("views", len(views), len(cameras))
        instants = list(_instants(settings, cameras))
        for index, instant in enumerate(instants):
            progress("simulate", index * len(views), len(instants) * len(views))
            truth = true_tracks(instant.time_ns, instant.places, rig.robot_of, cameras, settings)
            yield TRUTH_TOPIC, truth, instant.time_ns, None
            for image in pool.map(partial(_photograph, settings, instant, index), range(len(views)), views):
                yield image_topic(image.frame_id), image, instant.time_ns, image.frame_id
            for measurement in instant.measured:
                yield MEASUREMENTS_TOPIC, measurement, measurement.timestamp, None
        progress("simulate", len(instants) * len(views), len(instants) * len(views))


def _photograph(
    settings: LabSettings, instant: Instant, index: int, number: int, view: FloorView
) -> CompressedImage:
    """Render the frame of a camera at an instant; it does not depend on the threads."""
    rng = random_stream(settings.seed, Purpose.FRAME, number, index)
    prints = (*feet(settings, (instant.time_ns - EPOCH_NS) / NS_PER_S), *instant.prints)
    data = encode_jpeg(render(view, prints, settings, rng), settings)
    return CompressedImage(instant.time_ns, view.camera.name, data, "jpeg")


def _instants(settings: LabSettings, cameras: Sequence[Camera]) -> Iterator[Instant]:
    sets = calibration_points.plan_points(settings, cameras)
    splits = calibration_points.split(sets, settings.seed)
    for number, points in enumerate(sets):
        places = tuple(point.pose for point in points)
        lying = tuple(calibration_points.place_marker(pose, settings) for pose in places)
        times_ns = _times(settings, start_of_set_ns(settings, number), settings.frames_per_station)
        first = number * settings.markers
        measured = tuple(
            calibration_points.measure(pose, settings, index, times_ns, splits[index])
            for index, pose in enumerate(places, first)
        )
        for time_ns in times_ns[:-1]:
            yield Instant(time_ns, places, lying)
        yield Instant(times_ns[-1], places, lying, measured)
    drive, start_ns = plan_drive(settings, cameras), start_of_set_ns(settings, len(sets))
    for time_ns in _times(settings, start_ns, round(settings.drive_s * settings.rate_hz)):
        time_s = (time_ns - start_ns) / NS_PER_S
        prints = tuple(moving_marker(drive, marker_id, time_s, settings) for marker_id in drive.ahead_s)
        yield Instant(time_ns, drive.poses_at(time_s), prints)


def moving_marker(drive: Drive, marker_id: int, time_s: float, settings: LabSettings) -> MovingMarker:
    """Return a moving marker of the drive, for the frame at a time after the start."""
    return lambda since_s: calibration_points.place_marker(
        drive.pose_at(marker_id, time_s + since_s), settings
    )


def start_of_set_ns(settings: LabSettings, number: int) -> int:
    """Return the first time of a set of calibration points; after the last set, the start of the drive."""
    last_ns = _times(settings, 0, settings.frames_per_station)[-1]
    return EPOCH_NS + NS_PER_S + number * (last_ns + _PAUSE_NS)


def _times(settings: LabSettings, start_ns: int, count: int) -> list[int]:
    return [start_ns + round(index * NS_PER_S / settings.rate_hz) for index in range(count)]


def true_tracks(
    time_ns: int,
    places: Sequence[calibration_points.SimulatedPose],
    robot_of: Callable[[int], str],
    cameras: Sequence[Camera],
    settings: LabSettings,
) -> Tracks:
    """Return the ground truth of markers at an instant; ``robot_of`` returns the robot of a marker."""
    return Tracks(
        time_ns,
        tuple(
            Track(
                robot=robot_of(pose.marker_id),
                id=pose.marker_id,
                x_m=pose.x_m,
                y_m=pose.y_m,
                z_m=pose.z_m,
                heading_rad=pose.heading_rad,
                cameras=calibration_points.cameras_seeing(pose, cameras, settings),
            )
            for pose in places
        ),
    )
