"""Logs of several weeks without images: reference markers, slow changes, and a camera that is knocked."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.capture.simulation.cameras import Camera, sees
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.capture.simulation.settings import Purpose, random_stream
from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    IMPORTED,
    RIG_TOPIC,
    Array,
    Marker,
    Markers,
    Message,
    ReferenceMarker,
    Rig,
    Run,
    calibration_topic,
)
from ipsys_log.messages.channels import MARKERS, RECORD
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import make_pose, rotation, transform
from tests.geometric.corner_noise import corner_covariances, draw_corner_noise, edge_sigma_px
from tests.geometric.lab import GeometricLab
from tests.geometric.session import MARKERS_RUN, geometric_rig

# The id of the first reference marker.
FIRST_REFERENCE = 90
_WEEK_NS = 7 * 24 * 3600 * NS_PER_S
_LATENCY_NS = 50_000_000


@dataclass(frozen=True, slots=True)
class Knock:
    """The motion of a camera from a time on.

    ``turn_rad`` is a rotation vector about the axes of the camera, ``shift_m`` a motion in the world.
    ``after_s`` is the time from the start of the log of ``week``; at 0, the whole log is after the knock.
    """

    camera: str
    week: int
    turn_rad: tuple[float, float, float]
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    after_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class WeekSettings:
    """The settings of logs of several weeks, one log each week.

    Attributes
    ----------
    references : x, y, z in m, heading and tilt in rad of each reference marker. The tilt is about the
        marker's x axis, so a marker on a wall has a quarter turn.
    duration_s, rate_hz : duration of each log, and its frames per second.
    warming_px : by how much the image of a warm camera differs at its edge. The focal length grows by this
        share, and the principal point moves by this length. Room and time of warming differ from log to log.
    warming_s : time constant of the warming.
    light_px : slow changes of a marker by light, from log to log (standard deviation).
    knocks : motions of cameras.
    """

    references: tuple[tuple[float, float, float, float, float], ...] = (
        (1.0, 1.62, 0.0, 0.3, 0.0),
        (3.9, 1.62, 0.0, 2.0, 0.0),
        (1.0, 3.25, 0.0, -1.0, 0.0),
        (3.9, 3.25, 0.0, 1.0, 0.0),
        (2.4, 0.3, 0.0, 0.0, 0.0),
        (2.4, 4.6, 0.0, 0.0, 0.0),
        (2.4, 2.45, 0.0, 0.7, 0.0),
    )
    duration_s: float = 6.0
    rate_hz: float = 10.0
    warming_px: float = 0.2
    warming_s: float = 1200.0
    light_px: float = 0.05
    knocks: tuple[Knock, ...] = ()

    def __post_init__(self) -> None:
        numbers = {"duration_s": self.duration_s, "rate_hz": self.rate_hz, "warming_s": self.warming_s}
        for name, value in numbers.items():
            if not (math.isfinite(value) and value > 0):
                raise IpsysError(f"simulator setting {name} is {value!r}; give a number above 0")


def reference_rig(lab: GeometricLab, settings: WeekSettings) -> Rig:
    """Return the rig of a lab with its reference markers."""
    ids = range(FIRST_REFERENCE, FIRST_REFERENCE + len(settings.references))
    return replace(geometric_rig(lab), reference_markers=tuple(ReferenceMarker(number) for number in ids))


def week_start_ns(week: int) -> int:
    """Return the first time of the log of a week; weeks count from 1."""
    return EPOCH_NS + week * _WEEK_NS


def knock_camera(camera: Camera, knock: Knock) -> Camera:
    """Return a camera after a knock."""
    turned = rotation(np.array(knock.turn_rad)) @ camera.camera_from_world[:3, :3]
    origin_m = camera.origin_m + knock.shift_m
    return replace(camera, camera_from_world=make_pose(turned, -turned @ origin_m))


def simulate_week(lab: GeometricLab, settings: WeekSettings, week: int) -> Iterator[Message]:
    """Yield the messages of the log of a week, in log order.

    Equal labs and settings give equal messages. Markers belong to the run ``geometric`` of the stage
    ``import``.

    Parameters
    ----------
    lab : a simulated lab; its robots and calibration points are not in the log.
    settings : settings of all weeks.
    week : its number, from 1.
    """
    start_ns = week_start_ns(week)
    yield Message(RIG_TOPIC, start_ns, start_ns, reference_rig(lab, settings))
    for number, (name, lens) in enumerate(lab.calibrations.items(), 1):
        time_ns = start_ns + number
        yield Message(calibration_topic(name), time_ns, time_ns, replace(lens, timestamp=time_ns), name)
    frames = round(settings.duration_s * settings.rate_hz)
    views = [_View(lab, settings, week, number) for number in range(len(lab.cameras))]
    for frame in range(frames):
        time_ns = start_ns + NS_PER_S + round(frame * NS_PER_S / settings.rate_hz)
        for number, view in enumerate(views):
            name = lab.cameras[number].name
            markers = Markers(time_ns, view.markers(frame), lab.settings.lab.width, lab.settings.lab.height)
            log_ns = time_ns + _LATENCY_NS + number
            yield Message(MARKERS.topic_of(MARKERS_RUN, name), log_ns, time_ns, markers, name)
    run = Run(time_ns, MARKERS_RUN, IMPORTED, {"format": "geometric_lab"})
    yield Message(RECORD.topic_of(MARKERS_RUN), log_ns + 1, time_ns, run)


class _View:
    """The reference markers in the frames of a camera during the log of a week."""

    def __init__(self, lab: GeometricLab, settings: WeekSettings, week: int, number: int) -> None:
        self._lab, self._settings, self._week = lab, settings, week
        self._camera = lab.cameras[number]
        self._rng = random_stream(lab.settings.lab.seed, Purpose.WEEKS, week, number)
        # The room is warmer or colder, and the cameras have been on for some time.
        self._room, self._on_s = self._rng.uniform(0.7, 1.3), self._rng.uniform(0, 3600)
        direction = random_stream(lab.settings.lab.seed, Purpose.WEEKS, 0, number).uniform(0, 2 * np.pi)
        self._aside = np.array([np.cos(direction), np.sin(direction)])
        count = len(settings.references)
        self._light_px = self._rng.normal(0, settings.light_px, (count, 1, 2)) + self._rng.normal(
            0, settings.light_px / 2, (count, 4, 2)
        )
        self._length_m = lab.settings.lab.marker_length_m
        self._poses = [_pose(one) for one in settings.references]
        self._stated: dict[tuple[int, ...], Array] = {}

    def markers(self, frame: int) -> tuple[Marker, ...]:
        """Return the visible markers of a frame with the noise of ``detect``."""
        time_s = frame / self._settings.rate_hz
        camera = self._knocked(time_s)
        warm = self._warmed(camera, time_s)
        seen = [n for n, pose in enumerate(self._poses) if _is_whole(warm, pose, self._length_m)]
        if not seen:
            return ()
        placed = np.array([camera.camera_from_world @ self._poses[n] for n in seen])
        corners_c = marker_corners(self._length_m) @ placed[:, :3, :3].swapaxes(1, 2) + placed[:, None, :3, 3]
        true_px = project(corners_c.reshape(-1, 3), warm.lens).reshape(-1, 4, 2)
        key = (*seen, *(knock.after_s <= time_s for knock in self._settings.knocks))
        if key not in self._stated:
            self._stated[key] = self._covariances(camera, placed)
        noise_px = draw_corner_noise(self._stated[key], np.arange(len(seen)), self._rng)
        corners_px = true_px + noise_px + self._light_px[seen]
        return tuple(
            Marker(FIRST_REFERENCE + n, corners_px[row], self._stated[key][row]) for row, n in enumerate(seen)
        )

    def _covariances(self, camera: Camera, placed: Array) -> Array:
        """Return the stated covariances (n, 8, 8) of markers, in single precision; warmth has no effect."""
        sigma_px = edge_sigma_px(self._lab.settings.lab)
        covariances = corner_covariances(
            camera.lens, placed[:, :3, :3], placed[:, :3, 3], self._length_m, sigma_px
        )
        return np.asarray(covariances.astype(np.float32).astype(np.float64))

    def _knocked(self, time_s: float) -> Camera:
        camera = self._camera
        for knock in self._settings.knocks:
            is_past = (knock.week, knock.after_s) <= (self._week, time_s)
            if knock.camera == camera.name and is_past:
                camera = knock_camera(camera, knock)
        return camera

    def _warmed(self, camera: Camera, time_s: float) -> Camera:
        """Return a camera with the intrinsics of its temperature."""
        level = self._room * (1 - math.exp(-(self._on_s + time_s) / self._settings.warming_s))
        K = camera.lens.K.copy()
        edge_px = camera.lens.width / 2
        K[:2, :2] *= 1 + level * self._settings.warming_px / edge_px
        K[:2, 2] += level * self._settings.warming_px * self._aside
        return replace(camera, lens=replace(camera.lens, K=K))


def _pose(reference: tuple[float, float, float, float, float]) -> Array:
    """Return ``world_from_marker`` (4, 4) of a reference marker."""
    x_m, y_m, z_m, heading_rad, tilt_rad = reference
    turn = rotation(np.array([0, 0, heading_rad - np.pi / 2])) @ rotation(np.array([tilt_rad, 0, 0]))
    return make_pose(turn, np.array([x_m, y_m, z_m]))


def _is_whole(camera: Camera, world_from_marker: Array, length_m: float) -> bool:
    corners_m = transform(world_from_marker, marker_corners(1.03 * length_m))
    faces = float(world_from_marker[:3, 2] @ (camera.origin_m - world_from_marker[:3, 3])) > 0
    return faces and bool(sees(camera, corners_m).all())
