"""Live display in Rerun: a separate thread sends messages to a viewer."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import TracebackType

import rerun as rr

from ipsys_log.errors import IpsysError
from ipsys_log.images.video import is_keyframe
from ipsys_log.messages import (
    CompressedImage,
    CompressedVideo,
    Message,
    Rig,
    SkippedVideo,
    Tracks,
    image_topic,
)
from ipsys_log.sinks.rerun.messages import RerunSink, trail_entity
from ipsys_log.sinks.rerun.recording import check_screen, show_in_viewer
from ipsys_log.sinks.rerun.scene import draw_rig, layout
from ipsys_log.units import NS_PER_S

__all__ = ["LiveView"]

Write = Callable[[bytes], object]

# What may wait for a viewer that is slower than the cameras; pictures are left out first.
_WAITING = 100
_FADE_NS = NS_PER_S


class LiveView:
    """A Rerun viewer that shows what it is called with. A context manager; it never waits for the viewer.

    Parameters
    ----------
    rig, cameras, run : what there is to show; ``run`` is that of the tracks, None where there are none.
    say : is told why the viewer could not be shown.
    show : opens the viewer and feeds it; the real one unless a test gives another.

    Raises
    ------
    IpsysError
        On entering, where there is no screen.
    """

    def __init__(
        self,
        rig: Rig,
        cameras: Iterable[str],
        run: str | None,
        say: Callable[[str], object],
        show: Callable[[Callable[[Write], None]], None] = show_in_viewer,
    ) -> None:
        self._rig, self._cameras, self._run = rig, sorted(cameras), run
        self._say, self._show = say, show
        # Cameras whose video goes on with a keyframe only.
        self._broken: set[str | None] = set()
        self._waiting: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._show_all, name="view", daemon=True)

    def __enter__(self) -> LiveView:
        if self._show is show_in_viewer:
            check_screen(os.environ)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._waiting.put(None)
        # The window stays open for as long as its user wants.
        self._thread.join(timeout=2.0)

    def __call__(self, message: Message | None) -> None:
        """Show a message, soon."""
        if message is None:
            return
        if isinstance(message.payload, SkippedVideo):
            message = replace(message, payload=message.payload.frame)
        if self._left_out(message):
            return
        if self._waiting.qsize() < 2 * _WAITING:
            self._waiting.put(message)

    def _left_out(self, message: Message) -> bool:
        full = self._waiting.qsize() >= _WAITING
        if isinstance(message.payload, CompressedVideo):
            if full:
                self._broken.add(message.camera)
            elif is_keyframe(message.payload):
                self._broken.discard(message.camera)
            return message.camera in self._broken
        return full and isinstance(message.payload, CompressedImage)

    def _show_all(self) -> None:
        try:
            self._show(self._feed)
        except IpsysError as error:
            self._say(str(error))

    def _fades_ns(self) -> dict[str, int]:
        """By topic, after which time what is not seen any more is gone."""
        topics = [image_topic(camera) for camera in self._cameras]
        if self._run is not None:
            topics += [f"/runs/{self._run}/cameras/{camera}/positions" for camera in self._cameras]
            topics.append(f"/runs/{self._run}/tracks")
        return dict.fromkeys(topics, _FADE_NS)

    def _feed(self, write: Write) -> None:
        recording = rr.RecordingStream("ipsys", send_properties=False)
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        recording.send_recording_name("live")
        try:
            stream = rr.binary_stream(recording)
            trails = [] if self._run is None else [trail_entity(self._run)]
            recording.send_blueprint(layout(self._cameras, trails, self._rig, events=True))
            draw_rig(recording, self._rig)
            runs = () if self._run is None else (self._run,)
            sink = RerunSink(recording, self._cameras, self._fades_ns(), runs)
            while (message := self._waiting.get()) is not None:
                sink(message)
                if self._waiting.empty() or isinstance(message.payload, Tracks):
                    sink.flush()
                    write(stream.read() or b"")
            sink.close()
            write(stream.read() or b"")
        finally:
            recording.disconnect()
