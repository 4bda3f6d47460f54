"""A video or a log as a live camera: ``file:red.mp4``, ``file:session.mcap``, in real time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ipsys_log.capture.frames import Clock, Frame, Say, SourceError
from ipsys_log.capture.video_files import Timed, open_video
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, CompressedVideo, RigCamera
from ipsys_log.units import NS_PER_S

__all__ = ["check_played", "file_of", "open_played"]

_TURN_S = 0.4


@contextmanager
def open_played(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """The frames of a file, as :data:`~ipsys_log.capture.frames.Open` says, each at its time since the first.

    Parameters
    ----------
    camera : its ``source`` is ``file:`` and a video or a log; of a log, the camera of its own name is taken,
        or the one that is named: ``file:session.mcap?red``.
    clock : frames are stamped by it, as if they were taken now.
    say : told where pictures are encoded anew.

    Raises
    ------
    SourceError
        Where the file cannot be read, or a log has no such camera.
    """
    path, wanted = check_played(camera)
    if path.suffix != ".mcap":
        with open_video(path, say) as frames:
            yield _play(frames, clock)
        return
    with Session([path]) as session:
        topic = session.images.get(wanted or camera.name)
        if topic is None:
            known = ", ".join(f"{path}?{other}" for other in session.images) or "none"
            raise SourceError(f"camera {camera.name}: {path}: has no such camera; it has: {known}")
        yield _play(_recorded(session, topic), clock)


def check_played(camera: RigCamera) -> tuple[Path, str]:
    """The file that a source names, and the camera that it asks for, or nothing.

    Raises
    ------
    SourceError
        Where there is no such file.
    """
    path, wanted = file_of(camera.source or "")
    if not path.is_file():
        raise SourceError(f"camera {camera.name}: {path}: there is no such file")
    return path, wanted


def file_of(source: str) -> tuple[Path, str]:
    """The file in a source, and the camera of it that is asked for, or nothing.

    Examples
    --------
    >>> path, camera = file_of("file:session.mcap?red")
    >>> path.name, camera
    ('session.mcap', 'red')
    """
    name, _, wanted = source.partition(":")[2].partition("?")
    return Path(name), wanted


def _recorded(session: Session, topic: str) -> Iterator[Timed]:
    start_ns: int | None = None
    for message in session.messages([topic]):
        if not isinstance(message.payload, (CompressedImage, CompressedVideo)):
            raise SourceError(f"{session}: {topic}: its pictures are not compressed; only such are played")
        start_ns = message.publish_time_ns if start_ns is None else start_ns
        since_ns = message.publish_time_ns - start_ns
        yield Timed(since_ns, message.payload.data, message.payload.format)


def _play(frames: Iterator[Timed], clock: Clock) -> Iterator[Frame | None]:
    start_ns = clock.now_ns()
    for since_ns, data, format in frames:
        while (left_s := (start_ns + since_ns - clock.now_ns()) / NS_PER_S) > 0:
            time.sleep(min(left_s, _TURN_S))
            if left_s > _TURN_S:
                yield None
        yield Frame(data, format, start_ns + since_ns)
