"""The stage *smooth*: tracks that use the sightings before and after each instant, of the whole log."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping

from ipsys_log.errors import IpsysError
from ipsys_log.messages import STAMP_UNRELIABLE, Event, Model, Rig, Track, Tracks
from ipsys_log.messages.channels import EVENTS, MODEL, POSITIONS, RIG, SMOOTHED_TRACKS
from ipsys_log.messages.stage import Plan, Progress, Stage, StageView, Timed
from ipsys_log.tracking.bias_modes import BiasModes
from ipsys_log.tracking.smoothed_poses import Frame, SmoothedPose, smooth_positions
from ipsys_log.tracking.track_rows import make_track

__all__ = ["STAGE"]


def _compute(view: StageView, models: list[Model], progress: Progress) -> list[Timed]:
    rig = view.rig or next(iter(view.payloads(RIG)[-1:]), None)
    if rig is None:
        raise IpsysError("the log has no rig (robots and their markers): give one with --rig lab.toml")
    frames = list(_frames(view, rig))
    modes = BiasModes.none()
    if models:
        # Late: the modes of a joint model need scipy.
        from ipsys_log.tracking.calibration_modes import calibration_modes

        modes = calibration_modes(models[-1], rig)
    progress(0, len(frames))
    poses = smooth_positions(frames, modes)
    progress(len(frames), len(frames))
    return _messages(poses)


def _frames(view: StageView, rig: Rig) -> Iterator[Frame]:
    """Yield the positions of all frames, without late frames: these have wrong times."""
    late_ns = _late_intervals(view.payloads(EVENTS))
    for message in view.messages(POSITIONS):
        camera, time_ns, positions = str(message.camera), message.publish_time_ns, message.payload.positions
        if not any(start <= time_ns and (end is None or time_ns <= end) for start, end in late_ns[camera]):
            robots = [(rig.robot_of(position.id), position.id) for position in positions]
            yield Frame(time_ns, camera, message.log_time_ns, positions, robots)


def _late_intervals(events: Iterable[Event]) -> Mapping[str, list[tuple[int, int | None]]]:
    """Return the intervals of late frames by camera; the last event of an interval has its end."""
    ends: dict[str, dict[int, int | None]] = defaultdict(dict)
    for event in events:
        if event.kind == STAMP_UNRELIABLE and event.camera is not None and event.start is not None:
            ends[event.camera][event.start] = event.end
    return defaultdict(list, {camera: list(own.items()) for camera, own in ends.items()})


def _messages(poses: list[SmoothedPose]) -> list[Timed]:
    """Return a message for each instant. Log times do not decrease, although a sighting can be late."""
    by_time: dict[int, list[Track]] = defaultdict(list)
    log_times_ns: dict[int, int] = {}
    for log_time_ns, pose in poses:
        by_time[pose.time_ns].append(make_track(pose))
        log_times_ns[pose.time_ns] = max(log_time_ns, log_times_ns.get(pose.time_ns, 0))
    rows, newest_ns = [], 0
    for time_ns, tracks in by_time.items():
        newest_ns = max(newest_ns, log_times_ns[time_ns])
        tracks.sort(key=lambda track: track.id)
        rows.append(Timed(newest_ns, Tracks(time_ns, tuple(tracks))))
    return rows


def _plan(view: StageView, _options: Mapping[str, str]) -> Plan:
    models = view.payloads(MODEL) if view.run(MODEL) else []
    has_late_frames = any(event.kind == STAMP_UNRELIABLE for event in view.payloads(EVENTS))
    return Plan(
        run=view.run(POSITIONS),
        parameters={},
        reads=(RIG, POSITIONS, *([MODEL] if models else []), *([EVENTS] if has_late_frames else [])),
        compute=lambda progress: _compute(view, models, progress),
    )


STAGE = Stage(
    name="smooth",
    versions={"smooth": 1},
    reads=(RIG, POSITIONS, MODEL, EVENTS),
    writes=(SMOOTHED_TRACKS,),
    plan=_plan,
    rig_part=lambda rig, method: (
        {(m.id, m.robot, m.height_m, m.height_sigma_m) for m in rig.markers},
        rig.marker_height_m,
        rig.marker_height_sigma_m,
        rig.marker_length_m,
    ),
    causal=False,
    per_camera=False,
)
