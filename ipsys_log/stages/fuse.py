"""The stage *fuse*: the positions of all cameras to one track per robot."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from math import cos, pi, sin, sqrt
from typing import Any

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    STAMP_UNRELIABLE,
    Event,
    FrameTransform,
    FrameTransforms,
    Message,
    Model,
    Positions,
    Quaternion,
    Rig,
    Track,
    Tracks,
    Vector3,
)
from ipsys_log.messages.channels import EVENTS, MODEL, POSES, POSITIONS, RIG, TRACKS
from ipsys_log.messages.stage import Plan, Stage, StageView
from ipsys_log.tracking.bias_modes import BiasModes
from ipsys_log.tracking.bodies import Bodies
from ipsys_log.tracking.position_sightings import is_usable, read_sightings
from ipsys_log.tracking.tracks import Pose, RobotTracks, TrackSettings

__all__ = ["STAGE", "Fuse"]


class Fuse:
    """The stage *fuse*: it filters the positions of all cameras, each at its own capture time.

    A message of positions gives one pose of each robot in it, at the instant at which the marker was exposed.
    With time offsets (rolling shutter), the markers of a frame have several instants, earlier ones first.
    If synchronised cameras see a robot at the same instant, the first message gives the pose; the others
    improve the later poses. So a robot has one pose per instant, and no pose waits for another camera.

    A robot that no camera sees has predicted poses at the instants of the frames, until its track ends.

    Late frames have wrong times; an event of their camera names them. Their positions are in no pose.
    """

    def __init__(self, run: str, model: Model | None = None, settings: TrackSettings | None = None) -> None:
        self._run, self._model = run, model
        self._rig: Rig | None = None
        self._modes = BiasModes.none()
        self._settings, self._tracks = settings, RobotTracks(settings)
        self._bodies, self._has_bodies = Bodies(), False
        # By camera, the start and end time of its last late frames; None if there is no end yet.
        self._late_ns: dict[str, tuple[int, int | None]] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            self._use_rig(message.payload)
        elif isinstance(message.payload, Event):
            self._note_late(message.payload)
        elif isinstance(message.payload, Positions) and not self._is_late(message):
            if self._rig is None:
                raise IpsysError(
                    "the log has no rig (robots and their markers): give one with --rig lab.toml"
                )
            yield from self._messages(self._poses(message, self._rig))

    def _use_rig(self, rig: Rig) -> None:
        self._rig = rig
        names = [marker.robot for marker in rig.markers if marker.robot is not None]
        self._has_bodies = len(names) > len(set(names))
        if self._model is not None:
            # Late: the modes of a joint model need scipy.
            from ipsys_log.tracking.calibration_modes import calibration_modes

            before, self._modes = self._modes, calibration_modes(self._model, rig)
            if before.count != self._modes.count:
                self._tracks = RobotTracks(self._settings, self._modes.fade_m)

    def _note_late(self, event: Event) -> None:
        if event.kind == STAMP_UNRELIABLE and event.camera is not None and event.start is not None:
            self._late_ns[event.camera] = event.start, event.end

    def _is_late(self, message: Message) -> bool:
        start_ns, end_ns = self._late_ns.get(str(message.camera), (None, None))
        time_ns = message.publish_time_ns
        return start_ns is not None and start_ns <= time_ns and (end_ns is None or time_ns <= end_ns)

    def _poses(self, message: Message, rig: Rig) -> list[Pose]:
        camera = str(message.camera)
        positions = [position for position in message.payload.positions if is_usable(position)]
        poses: list[Pose] = []
        if positions:
            sightings, has_covariance = read_sightings(camera, positions, self._modes)
            robots = [(rig.robot_of(position.id), position.id) for position in positions]
            if self._has_bodies:
                self._bodies.learn(robots, sightings)
                rows = [row for row, robot in enumerate(robots) if self._bodies.knows(*robot)]
                positions, robots = [positions[row] for row in rows], [robots[row] for row in rows]
                sightings = self._bodies.move(robots, sightings.take(np.array(rows, dtype=np.intp)))
                has_covariance = has_covariance[rows]
                robots = [(name, self._bodies.reference(name, number)) for name, number in robots]
            poses = self._tracks.observe(
                camera,
                robots,
                [message.publish_time_ns + (position.time_offset_ns or 0) for position in positions],
                sightings,
                [position.inside for position in positions],
                has_covariance.tolist(),
            )
        return poses + self._tracks.coast(message.publish_time_ns)

    def _messages(self, poses: list[Pose]) -> Iterator[Any]:
        tracks_by_time: dict[int, list[Track]] = defaultdict(list)
        for pose in poses:
            tracks_by_time[pose.time_ns].append(_track(pose))
        for time_ns, tracks in sorted(tracks_by_time.items()):
            tracks.sort(key=lambda track: track.id)
            yield Tracks(time_ns, tuple(tracks))
            yield FrameTransforms(tuple(_transform(track, self._run, time_ns) for track in tracks))


def _track(pose: Pose) -> Track:
    mean, covariance = pose.states.means[pose.state], pose.states.covariances[pose.state]
    robot, marker_id = pose.robot
    x_m, y_m, z_m, heading_rad, _, _, _, turn_rate, _, _ = mean.tolist()
    heading_sigma_rad, turn_sigma_rad_s = sqrt(covariance[3, 3]), sqrt(covariance[7, 7])
    has_heading = heading_sigma_rad < _UNKNOWN_HEADING_RAD
    return Track(
        robot,
        marker_id,
        x_m,
        y_m,
        z_m,
        (heading_rad + pi) % (2 * pi) - pi if has_heading else None,
        covariance[:3, :3] if pose.has_covariance else None,
        pose.cameras,
        pose.inside,
        mean[4:7],
        covariance[4:7, 4:7] if pose.has_covariance else None,
        heading_sigma_rad if has_heading and pose.has_covariance else None,
        turn_rate if has_heading else None,
        turn_sigma_rad_s if has_heading and pose.has_covariance else None,
        pose.coasting_ns,
    )


# A heading that was never measured has a larger standard deviation.
_UNKNOWN_HEADING_RAD = 2.0


def _transform(track: Track, run: str, time_ns: int) -> FrameTransform:
    # A transform must have a rotation; /runs/<run>/tracks shows that the heading is missing.
    half_rad = (track.heading_rad or 0.0) / 2
    return FrameTransform(
        time_ns,
        "world",
        f"{run}/{track.robot}",
        Vector3(track.x_m, track.y_m, track.z_m),
        Quaternion(0.0, 0.0, sin(half_rad), cos(half_rad)),
    )


def _plan(view: StageView, _options: Mapping[str, str]) -> Plan:
    models = view.payloads(MODEL) if view.run(MODEL) else []
    has_late_frames = any(event.kind == STAMP_UNRELIABLE for event in view.payloads(EVENTS))
    return Plan(
        run=view.run(POSITIONS),
        parameters={},
        # A log without such events keeps its existing runs.
        reads=(RIG, POSITIONS, *([MODEL] if models else []), *([EVENTS] if has_late_frames else [])),
        step=lambda run: Fuse(run, models[-1] if models else None),
    )


STAGE = Stage(
    name="fuse",
    versions={"fuse": 2},
    reads=(RIG, POSITIONS, MODEL, EVENTS),
    writes=(TRACKS, POSES),
    plan=_plan,
    rig_part=lambda rig, method: (
        {(m.id, m.robot, m.height_m, m.height_sigma_m) for m in rig.markers},
        rig.marker_height_m,
        rig.marker_height_sigma_m,
    ),
    per_camera=False,
)
