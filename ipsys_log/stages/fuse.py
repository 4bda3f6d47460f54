"""The stage *fuse*: the positions of all cameras to one track per robot."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
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
from ipsys_log.messages.channels import POSES, POSITIONS, TRACKS
from ipsys_log.messages.stage import Plan, Stage, StageView
from ipsys_log.models.tracking.frame_reader import FrameReader
from ipsys_log.models.tracking.track_messages import (
    TRACK_READS,
    LateFrames,
    make_track,
    model_of,
    track_reads,
    tracked_part,
)
from ipsys_log.models.tracking.tracks import FREE_BODIES, Pose, RobotTracks
from ipsys_log.vision.bodies import track_quaternion


class Fuse:
    """The stage *fuse*: it filters the positions of all cameras, each at its own capture time.

    A message of positions gives one pose of each robot in it, at the instant at which the marker was exposed.
    With time offsets (rolling shutter), the markers of a frame have several instants, earlier ones first.
    If synchronised cameras see a robot at the same instant, the first message gives the pose; the others
    improve the later poses. So a robot has one pose per instant, and no pose waits for another camera.

    A robot that no camera sees has predicted poses at the instants of the frames, until its track ends.

    Late frames have wrong times; an event of their camera names them. Their positions are in no pose.
    """

    def __init__(self, run: str, model: Model | None = None) -> None:
        self._run, self._reader = run, FrameReader(model)
        self._rig: Rig | None = None
        self._tracks, self._bodies = RobotTracks(), RobotTracks(FREE_BODIES)
        self._late_frames = LateFrames()

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            self._use_rig(message.payload)
        elif isinstance(message.payload, Event):
            self._late_frames.note(message.payload)
        elif isinstance(message.payload, Positions) and not self._late_frames.has(message):
            if self._rig is None:
                raise IpsysError(
                    "the log has no rig (robots and their markers): give one with --rig lab.toml"
                )
            yield from self._messages(self._poses(message))

    def _use_rig(self, rig: Rig) -> None:
        self._rig = rig
        count = self._reader.modes.count
        self._reader.use_rig(rig)
        if count != self._reader.modes.count:
            self._tracks = RobotTracks(fade_m=self._reader.modes.fade_m)

    def _poses(self, message: Message) -> list[Pose]:
        time_ns = message.publish_time_ns
        poses = [*self._tracks.coast_before(time_ns), *self._bodies.coast_before(time_ns)]
        for frame in self._reader.read(str(message.camera), time_ns, message.payload.positions):
            tracks = self._tracks if frame.sightings.turns is None else self._bodies
            poses += tracks.observe(
                frame.camera,
                frame.robots,
                frame.times_ns,
                frame.sightings,
                frame.inside,
                frame.has_covariance,
            )
        return poses

    def _messages(self, poses: list[Pose]) -> Iterator[Any]:
        tracks_by_time: dict[int, list[Track]] = defaultdict(list)
        for pose in poses:
            tracks_by_time[pose.time_ns].append(make_track(pose))
        for time_ns, tracks in sorted(tracks_by_time.items()):
            tracks.sort(key=lambda track: track.id)
            yield Tracks(time_ns, tuple(tracks))
            yield FrameTransforms(tuple(_transform(track, self._run, time_ns) for track in tracks))


def _transform(track: Track, run: str, time_ns: int) -> FrameTransform:
    # A transform must have a rotation; /runs/<run>/tracks shows that a heading is missing.
    turned = Quaternion(*track_quaternion(track))
    place = Vector3(track.x_m, track.y_m, track.z_m)
    return FrameTransform(time_ns, "world", f"{run}/{track.robot}", place, turned)


def _plan(view: StageView, _options: Mapping[str, str]) -> Plan:
    model = model_of(view)
    return Plan(
        run=view.run(POSITIONS),
        parameters={},
        reads=track_reads(view),
        step=lambda run: Fuse(run, model),
    )


STAGE = Stage(
    name="fuse",
    versions={"fuse": 5},
    reads=TRACK_READS,
    writes=(TRACKS, POSES),
    plan=_plan,
    rig_part=tracked_part,
    per_camera=False,
)
