"""The stage *smooth*: tracks that use the sightings before and after each instant, of the whole log."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Tracks
from ipsys_log.messages.channels import EVENTS, POSITIONS, RIG, SMOOTHED_TRACKS
from ipsys_log.messages.stage import Plan, Progress, Stage, StageView, Timed
from ipsys_log.models.tracking.smoothed_poses import Frame, SmoothedPose, smooth_positions
from ipsys_log.models.tracking.track_messages import (
    TRACK_READS,
    LateFrames,
    make_track,
    model_of,
    track_reads,
    tracked_part,
)

_STEPS = 3


def _compute(view: StageView, progress: Progress) -> Iterator[Timed]:
    rig = view.rig or next(iter(view.payloads(RIG)[-1:]), None)
    if rig is None:
        raise IpsysError("the log has no rig (robots and their markers): give one with --rig lab.toml")
    count = view.count(POSITIONS)
    # Frames are read, then filtered, then smoothed: each of them counts once for each step.
    total = max(_STEPS * count, 1)
    progress(0, total)
    frames = _frames(view, lambda done: progress(done, total))
    poses = smooth_positions(
        frames,
        rig,
        model_of(view),
        progress=lambda share: progress(count + round(share * (total - count)), total),
    )
    progress(total, total)
    return _messages(poses)


def _frames(view: StageView, progress: Callable[[int], None]) -> Iterator[Frame]:
    """Yield the positions of all frames, without late frames: these have wrong times."""
    late_frames = LateFrames(view.payloads(EVENTS))
    for done, message in enumerate(view.messages(POSITIONS), 1):
        progress(done)
        if not late_frames.has(message):
            camera, time_ns = str(message.camera), message.publish_time_ns
            yield Frame(time_ns, camera, message.log_time_ns, message.payload.positions)


def _messages(poses: Sequence[SmoothedPose]) -> Iterator[Timed]:
    """Yield a message for each instant. Log times do not decrease, although a sighting can be late."""
    newest_ns = 0
    for time_ns, together in groupby(poses, key=lambda one: one.pose.time_ns):
        tracks = []
        for log_time_ns, pose in together:
            tracks.append(make_track(pose))
            newest_ns = max(newest_ns, log_time_ns)
        tracks.sort(key=lambda track: track.id)
        yield Timed(newest_ns, Tracks(time_ns, tuple(tracks)))


def _plan(view: StageView, _options: Mapping[str, str]) -> Plan:
    return Plan(
        run=view.run(POSITIONS),
        parameters={},
        reads=track_reads(view),
        compute=lambda progress: _compute(view, progress),
    )


STAGE = Stage(
    name="smooth",
    versions={"smooth": 3},
    reads=TRACK_READS,
    writes=(SMOOTHED_TRACKS,),
    plan=_plan,
    rig_part=tracked_part,
    causal=False,
    per_camera=False,
    on_demand=True,
)
