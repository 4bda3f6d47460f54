"""Video files of logs: MP4 with H.264, at a constant frame rate in the time of the log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, Message, Rig
from ipsys_log.messages.channels import MARKERS, TRACKS
from ipsys_log.sinks.colours import robot_colour
from ipsys_log.sinks.selection import choose_runs, fade_ns, rig_in_force
from ipsys_log.sinks.video.canvas import Picture
from ipsys_log.sinks.video.composite import Composite
from ipsys_log.sinks.video.floor_map import Scene, enlargement
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    from av.video.stream import VideoStream

_STEP = "video"
_LEAST_PX, _MOST_PX = 160, 4096
_LEAST_HZ, _MOST_HZ = 1.0, 120.0
# A longer silence of the log is shortened to this time: a log may have a break of days.
_SILENCE_NS, _SHORTENED_NS = 10 * NS_PER_S, 2 * NS_PER_S
# A usual ellipse has about this radius on the map, as a share of its larger side.
_RADIUS_SHARE = 0.02
_SAMPLE = 20_000
_MARGIN = 0.03
_LEAST_SIDE_M, _LEAST_SHAPE = 0.5, 0.6
_KEYFRAME_S = 2
_BT709, _LIMITED = 1, 1


class VideoCounts(NamedTuple):
    """The number of frames of a video, and its duration in s."""

    frames: int
    duration_s: float


def check_settings(rate_hz: float, size_px: tuple[int, int]) -> None:
    """Check the frame rate and the size of a video.

    Raises
    ------
    IpsysError
        They are out of range, or the size is odd: H.264 stores the colours of blocks of 2 x 2 px.
    """
    if not (isfinite(rate_hz) and _LEAST_HZ <= rate_hz <= _MOST_HZ):
        raise IpsysError(
            f"--frame-rate {rate_hz:g}: is not valid; give {_LEAST_HZ:g} to {_MOST_HZ:g} frames per second"
        )
    if not all(_LEAST_PX <= side <= _MOST_PX and side % 2 == 0 for side in size_px):
        raise IpsysError(
            f"--size {size_px[0]}x{size_px[1]}: is not valid; give two even numbers from {_LEAST_PX} to "
            f"{_MOST_PX}, such as 1280x720"
        )


def write_video(
    session: Session,
    run: str,
    path: Path,
    robot: str | None = None,
    rate_hz: float = 25.0,
    size_px: tuple[int, int] = (1280, 720),
    progress: Progress = lambda step, done, total: None,
) -> VideoCounts:
    """Write a video of the cameras and the floor; an old file stays until the new one is complete.

    A frame shows all messages with a log time up to its own. A silence of more than 10 s becomes 2 s.

    Parameters
    ----------
    run : the run of the tracks.
    robot : draw only this robot on the floor.
    rate_hz, size_px : frames per second; width and height, both even.
    """
    check_settings(rate_hz, size_px)
    if not session.images:
        raise IpsysError(f"{session}: has no images for a video; export a log with images")
    scene, topics = read_scene(session, run, robot)
    rate = Fraction(rate_hz).limit_denominator(1001)
    total = sum(map(session.count, topics))
    messages = _counted(session.messages(topics), total, progress)
    with replacement_of(path) as file:
        frames = _encode(Path(file.name), timed_pictures(messages, scene, size_px, rate), rate, size_px)
    return VideoCounts(frames, float(frames / rate))


def _counted(messages: Iterable[Message], total: int, progress: Progress) -> Iterator[Message]:
    for done, message in enumerate(messages):
        progress(_STEP, done, total)
        yield message
    progress(_STEP, total, total)


def read_scene(session: Session, run: str, robot: str | None = None) -> tuple[Scene, list[str]]:
    """Return the constant part of the video of a run, and the topics that it shows."""
    shown = choose_runs(session, [run])
    tracks = session.topics(TRACKS, run)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    robots: set[str] = set()
    for payload in (message.payload for message in session.messages(tracks)):
        for track in payload.tracks:
            point = np.array([track.x_m, track.y_m])
            if np.isfinite(point).all():
                robots.add(track.robot)
                low, high = np.minimum(low, point), np.maximum(high, point)
    if robot is not None and robot not in robots:
        known = ", ".join(sorted(robots)) or "none"
        raise IpsysError(f"{session}: tracks has no robot {robot!r} (it has: {known})")
    rig = rig_in_force(session, [run])
    low, high = _visible(rig, low, high)
    radius_m = _RADIUS_SHARE * float((high - low).max())
    colours = {name: robot_colour(number) for number, name in enumerate(sorted(robots))}
    scene = Scene(
        tuple(sorted(session.images)),
        {name: colour for name, colour in colours.items() if robot in (None, name)},
        rig,
        low,
        high,
        enlargement(_covariances(session, tracks), radius_m),
        max(fade_ns(session, tracks).values(), default=NS_PER_S),
        run,
    )
    marked = session.topics(MARKERS, shown.markers) if shown.markers else []
    return scene, [*session.images.values(), *marked, *tracks]


def _covariances(session: Session, topics: list[str]) -> list[Array]:
    found = (
        track.covariance_m2[:2, :2]
        for message in session.messages(topics)
        for track in message.payload.tracks
        if track.covariance_m2 is not None and np.isfinite(track.covariance_m2).all()
    )
    return list(islice(found, _SAMPLE))


def _visible(rig: Rig | None, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the lowest and highest x and y on the map: those of the rig's floor, else of the tracks."""
    if rig is not None and rig.floor is not None:
        low, high = np.zeros(2), np.array([rig.floor.width_m, rig.floor.depth_m])
    elif not np.isfinite(low).all():
        low, high = np.zeros(2), np.ones(2)
    margin = max(_MARGIN * float((high - low).max()), 0.1)
    least = max(_LEAST_SIDE_M, _LEAST_SHAPE * float((high - low).max()))
    short = np.maximum(least - (high - low), 0.0) / 2
    return low - margin - short, high + margin + short


def timed_pictures(
    messages: Iterable[Message], scene: Scene, size_px: tuple[int, int], rate_hz: Fraction
) -> Iterator[Picture]:
    """Yield the pictures of a video, one for each frame; a picture is valid until the next one."""
    composite: Composite | None = None
    base_ns = number = 0

    def frame_ns() -> int:
        return base_ns + int(number * NS_PER_S / rate_hz)

    for message in messages:
        if composite is None:
            base_ns = message.log_time_ns
            composite = Composite(scene, size_px, base_ns)
        is_silent = message.log_time_ns - frame_ns() > _SILENCE_NS
        end_ns = frame_ns() + _SHORTENED_NS if is_silent else message.log_time_ns
        while frame_ns() < end_ns:
            yield composite.draw(frame_ns())
            number += 1
        if is_silent:
            base_ns, number = message.log_time_ns, 0
        composite.add(message)
    if composite is not None:
        yield composite.draw(frame_ns())


def _encode(path: Path, pictures: Iterable[Picture], rate_hz: Fraction, size_px: tuple[int, int]) -> int:
    """Write pictures into a file; return their number."""
    import av

    count = 0
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("h264", rate_hz)
        _configure(stream, rate_hz, size_px)
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="itu709")
            frame.pts = count
            frame.time_base = 1 / rate_hz
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode(None))
    return count


def _configure(stream: VideoStream, rate_hz: Fraction, size_px: tuple[int, int]) -> None:
    stream.width, stream.height = size_px
    stream.pix_fmt = "yuv420p"
    stream.options = {"crf": "20", "preset": "veryfast", "g": str(round(rate_hz * _KEYFRAME_S))}
    context = stream.codec_context
    context.time_base = 1 / rate_hz
    # Without these, players guess the matrix of the colours by the size.
    context.colorspace = context.color_primaries = context.color_trc = _BT709
    context.color_range = _LIMITED
