"""Drives through geometric labs for the benchmark of tracks: calibrations, and the positions of each camera.

A drive has other noise than the session that calibrated its lab, and another path.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from geometric_labs import Scene, Session, fit_session, make_session
from numpy.typing import NDArray
from rendered_sessions import rendered_session
from stops import Pace, Stops, draw_pace, pace_drive, velocities_over

from ipsys_log.calibration.joint.payload import JOINT, joint_payload
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CameraCalibration, CameraPoints, Markers, Message, Model, Positions, Rig
from ipsys_log.models.locate_corners import LocateCorners
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.stages.camera_frame import CameraFrame
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.units import NS_PER_S
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab, poses_over
from tests.geometric.session import simulate_session
from tests.geometric.sightings import start_ns

__all__ = ["CALIBRATIONS", "Condition", "SeenDrive", "Truth", "calibrate", "cover", "drive_through"]

Array = NDArray[np.float64]
Times = NDArray[np.int64]

# The drive has this seed besides that of its lab, for other noise.
_OTHER_NOISE = 500_000
# The stops of the robots have their own random numbers.
_STOPS_STREAM = 2
_CLOCKS_S, _DELAYS_S = 0.025, (0.0, 0.011, 0.022)
_ROW_TIME_NS = 31_000
_ROBOTS, _RATE_HZ = 3, 30.0
# Names of calibrations: a model, and whether a drive of 120 s is added to the 75 points.
CALIBRATIONS: dict[str, tuple[str, bool]] = {
    "joint": (JOINT, False),
    "joint, drive": (JOINT, True),
    "best": ("best", False),
    "rayplane": ("rayplane", False),
    "poly": ("poly", False),
}


@dataclass(frozen=True, slots=True)
class Condition:
    """The condition of a drive, by its name: speed, shutter, clocks, unevenness of the floor, and stops.

    With ``unknown_clocks``, the stamps of each camera have an unknown offset of up to 25 ms. With ``keep``, a
    folder, markers come from images, which are rendered once (``rendered_sessions.py``).
    """

    name: str
    speed_m_s: float
    rolling: bool = False
    unknown_clocks: bool = False
    floor_rms_m: float = 0.0
    height_sigma_m: float = 0.0
    stops: Stops | None = None
    keep: Path | None = None

    def settings(self, lab: LabSettings, points: int) -> GeometricSettings:
        """Return the settings of a session of the lab under this condition."""
        return GeometricSettings(
            lab=replace(lab, row_time_ns=_ROW_TIME_NS if self.rolling else 0),
            points=points,
            clock_offset_s=_CLOCKS_S if self.unknown_clocks else 0.0,
            frame_delays_s=_DELAYS_S,
            floor_rms_m=self.floor_rms_m,
            robot_height_sigma_m=self.height_sigma_m,
        )


def calibrate(condition: Condition, name: str, seed: int) -> Model:
    """Return a calibration of a lab, by its name in ``CALIBRATIONS``; the speed of its drive is usual."""
    return _calibrate(replace(condition, name="", speed_m_s=0.5, stops=None), name, seed)


@cache
def _calibrate(condition: Condition, name: str, seed: int) -> Model:
    model, drives = CALIBRATIONS[name]
    settings = LabSettings(rate_hz=10.0, drive_s=120.0 if drives else 0.0, markers=1 if drives else 3)
    session = _session(condition, Scene(name, condition.settings(settings, 75)), seed)
    if model == JOINT:
        return joint_payload(fit_session(session), session.pairs, 0)
    return fit_model(model, session.pairs, 0)


def _session(condition: Condition, scene: Scene, seed: int) -> Session:
    if condition.keep is None:
        session: Session = make_session(scene, seed)
        return session
    lab = build_lab(scene.seeded(seed))
    messages = rendered_session(lab, condition.keep)
    return Session(lab, messages, next(one.payload for one in messages if isinstance(one.payload, Rig)))


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The ground truth of a drive. Times are stamps of the clock of the positions.

    ``late_ns`` is the time of this clock minus the true time.
    """

    lab: GeometricLab
    late_ns: int

    def poses(self, robot: int, times_ns: Times) -> Array:
        """Return x, y, z and heading of a robot at times (n,): (n, 4), in m and rad."""
        path = poses_over(self.lab.drive, robot, self._since_s(times_ns))
        heights_m = np.full(len(path), self.lab.robot_heights_m[robot]) + self.lab.floor.at(path[:, :2])
        return np.insert(path, 2, heights_m, axis=1)

    def velocities(self, robot: int, times_ns: Times) -> Array:
        """Return the velocities of a robot at times (n,): (n, 2), in m/s."""
        return velocities_over(self.lab.drive, robot, self._since_s(times_ns))

    def _since_s(self, times_ns: Times) -> Array:
        since: Array = (times_ns - self.late_ns - start_ns(self.lab, len(self.lab.points))) / NS_PER_S
        return since


# Without slots, because of the cached sightings.
@dataclass(frozen=True, eq=False)
class SeenDrive:
    """A drive as the stage that tracks gets it: the rig, the model, and the positions of each camera.

    Attributes
    ----------
    model : the calibration.
    rig : as the user has it.
    positions : messages in log order.
    truth : the ground truth.
    camera_places_m : place of each camera above the floor, (2,), by its name.
    """

    model: Model
    rig: Rig
    positions: tuple[Message, ...]
    truth: Truth
    camera_places_m: dict[str, Array] = field(default_factory=dict)

    def messages(self) -> Iterator[Message]:
        """Yield all messages in log order."""
        first_ns = self.positions[0].log_time_ns
        yield Message("/rig", first_ns - 1, first_ns - 1, self.rig)
        yield from self.positions

    @cached_property
    def sightings(self) -> dict[int, tuple[Times, NDArray[np.str_], Array]]:
        """Times (n,), cameras (n,) and points (n, 3) of the positions of each robot, in order of time."""
        rows: dict[int, list[tuple[int, str, float, float, float]]] = {}
        for message in self.positions:
            for one in message.payload.positions:
                time_ns = message.publish_time_ns + (one.time_offset_ns or 0)
                rows.setdefault(one.id, []).append((time_ns, str(message.camera), one.x_m, one.y_m, one.z_m))
        sightings = {}
        for robot, seen in sorted(rows.items()):
            seen.sort()
            times_ns = np.array([row[0] for row in seen], dtype=np.int64)
            sightings[robot] = times_ns, np.array([row[1] for row in seen]), np.array([r[2:] for r in seen])
        return sightings


def drive_through(condition: Condition, model: Model, seed: int, duration_s: float) -> SeenDrive:
    """Simulate a drive of three robots, and locate them by a calibration of the same lab."""
    settings = LabSettings(
        seed=seed,
        rate_hz=_RATE_HZ,
        drive_s=duration_s,
        drive_speed_m_s=condition.speed_m_s,
        markers=_ROBOTS,
    )
    lab = build_lab(condition.settings(settings, 0))
    noise = replace(lab.settings, lab=replace(lab.settings.lab, seed=seed + _OTHER_NOISE))
    path = replace(lab.drive.path, mirrored=not lab.drive.path.mirrored)
    mirrored = replace(lab.drive, path=path)
    drive = pace_drive(mirrored, _paces(condition, seed, duration_s))
    lab = replace(lab, settings=noise, drive=drive)
    keep = condition.keep
    messages = list(simulate_session(lab)) if keep is None else rendered_session(lab, keep)
    # The time of the joint model is that of its first camera.
    late_ns = lab.clock_offsets_ns[model.cameras[0].camera] if model.name == JOINT else 0
    return SeenDrive(
        model,
        next(message.payload for message in messages if isinstance(message.payload, Rig)),
        tuple(_located(messages, model)),
        Truth(lab, late_ns),
        {camera.name: camera.origin_m[:2] for camera in lab.cameras},
    )


def _paces(condition: Condition, seed: int, duration_s: float) -> dict[int, Pace]:
    if condition.stops is None:
        return {}
    rng = np.random.default_rng([seed, _STOPS_STREAM])
    return {
        robot: draw_pace(condition.stops, condition.speed_m_s, duration_s, rng) for robot in range(_ROBOTS)
    }


def cover(drive: SeenDrive, gaps_ns: Sequence[tuple[int, int]]) -> SeenDrive:
    """Return a drive without the positions in some intervals, as if all cameras were covered."""
    positions = tuple(
        replace(message, payload=replace(message.payload, positions=()))
        if any(start <= message.publish_time_ns < end for start, end in gaps_ns)
        else message
        for message in drive.positions
    )
    return replace(drive, positions=positions)


def _located(messages: list[Message], model: Model) -> Iterator[Message]:
    if model.name == JOINT:
        yield from _through(LocateCorners(model), messages, (Rig, Markers), Positions)
        return
    points = _through(CameraFrame(), messages, (Rig, CameraCalibration, Markers), CameraPoints)
    rig = [message for message in messages if isinstance(message.payload, Rig)]
    yield from _through(LocatePoints(model), [*rig, *points], (Rig, CameraPoints), Positions)


def _through(
    step: CameraFrame | LocatePoints | LocateCorners,
    messages: list[Message],
    reads: tuple[type, ...],
    writes: type,
) -> Iterator[Message]:
    for message in messages:
        if isinstance(message.payload, reads):
            for payload in step(message):
                if isinstance(payload, writes):
                    yield replace(message, payload=payload)
