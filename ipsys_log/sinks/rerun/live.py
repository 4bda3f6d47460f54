"""Live display in Rerun: a separate thread sends messages to a viewer."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator

import rerun as rr

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message, Rig, Tracks, image_topic
from ipsys_log.sinks.rerun.messages import RerunSink, trail_entity
from ipsys_log.sinks.rerun.recording import check_screen, show_in_viewer
from ipsys_log.sinks.rerun.scene import draw_rig, layout
from ipsys_log.units import NS_PER_S

__all__ = ["LiveView"]

Write = Callable[[bytes], object]

_FADE_NS = NS_PER_S


class LiveView:
    """A :class:`~ipsys_log.sinks.sink.Sink` that shows a recording in a Rerun viewer.

    Parameters
    ----------
    rig, cameras, run : content of the display; ``run`` is the run of the tracks, None without tracks.
    say : called with the reason if the viewer could not be shown.
    show : opens the viewer and feeds it; a test replaces the real viewer.

    Raises
    ------
    IpsysError
        There is no screen.
    """

    name = "the viewer"

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
        if show is show_in_viewer:
            check_screen(os.environ)

    def consume(self, messages: Iterator[Message | None]) -> None:
        """Show the messages until they end."""
        try:
            self._show(lambda write: self._feed(write, messages))
        except IpsysError as error:  # a missing viewer is not an error of the recording
            self._say(str(error))

    def _fades_ns(self) -> dict[str, int]:
        """Return by topic the time in ns after which its last entity is cleared."""
        topics = [image_topic(camera) for camera in self._cameras]
        if self._run is not None:
            topics += [f"/runs/{self._run}/cameras/{camera}/positions" for camera in self._cameras]
            topics.append(f"/runs/{self._run}/tracks")
        return dict.fromkeys(topics, _FADE_NS)

    def _feed(self, write: Write, messages: Iterator[Message | None]) -> None:
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
            for message in messages:
                if message is not None:
                    sink(message)
                if message is None or isinstance(message.payload, Tracks):
                    sink.flush()
                    write(stream.read() or b"")
            sink.close()
            write(stream.read() or b"")
        finally:
            recording.disconnect()
