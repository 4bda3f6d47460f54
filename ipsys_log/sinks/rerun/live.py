"""Live display in Rerun: a separate thread sends messages to a viewer."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator

import rerun as rr

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Event, Markers, Message, Positions, Rig, Tracks, image_topic
from ipsys_log.messages.channels import IMAGES
from ipsys_log.sinks.rerun.messages import RerunSink, trail_entity
from ipsys_log.sinks.rerun.scene import draw_legend, draw_rig, layout, symbol_scale
from ipsys_log.sinks.rerun.viewer import check_screen, show_in_viewer
from ipsys_log.sinks.streams.poses import NewSession
from ipsys_log.units import NS_PER_S

Write = Callable[[bytes], object]

_FADE_NS = NS_PER_S


class LiveView:
    """A :class:`~ipsys_log.sinks.sink.QueuedSink` that shows a recording in a Rerun viewer.

    Parameters
    ----------
    rig, cameras, run : content of the display; ``run`` is the run of the tracks, None without tracks.
        Without cameras, no images are shown.
    say : called with the reason if the viewer could not be shown.
    show : opens the viewer and feeds it; a test replaces the real viewer.
    name : the name of the sink in events.

    Raises
    ------
    IpsysError
        There is no screen.
    """

    def __init__(
        self,
        rig: Rig | None,
        cameras: Iterable[str],
        run: str | None,
        say: Callable[[str], object],
        show: Callable[[Callable[[Write], None]], None] = show_in_viewer,
        name: str = "the viewer",
    ) -> None:
        self.name = name
        self._rig, self._cameras, self._run = rig, sorted(cameras), run
        self._say, self._show = say, show
        pictures = (*IMAGES.payloads, Markers) if self._cameras else ()
        self.payloads: tuple[type, ...] = (Tracks, Positions, Event, NewSession, *pictures)
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
        """Draw the messages; each session of a playback is a recording of its own, because times go back."""
        begun: Message | None = None
        while True:
            name = "live" if begun is None else f"session {begun.payload.number}"
            begun = self._draw(name, write, messages)
            if begun is None:
                return

    def _draw(self, name: str, write: Write, messages: Iterator[Message | None]) -> Message | None:
        """Draw one recording; return the message that begins the next one, None at the end."""
        recording = rr.RecordingStream("ipsys", send_properties=False)
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        recording.send_recording_name(name)
        try:
            stream = rr.binary_stream(recording)
            sink = self._begin(recording)
            is_empty, begun = True, None
            for message in messages:
                if message is not None and isinstance(message.payload, NewSession):
                    if is_empty:
                        continue
                    begun = message
                    break
                if message is not None:
                    sink(message)
                    is_empty = False
                if message is None or isinstance(message.payload, Tracks):
                    sink.flush()
                    write(stream.read() or b"")
            sink.close()
            write(stream.read() or b"")
            return begun
        finally:
            recording.disconnect()

    def _begin(self, recording: rr.RecordingStream) -> RerunSink:
        trails = [] if self._run is None else [trail_entity(self._run)]
        recording.send_blueprint(layout(self._cameras, trails, self._rig, events=True))
        draw_rig(recording, self._rig)
        draw_legend(recording)
        runs = () if self._run is None else (self._run,)
        return RerunSink(recording, self._cameras, self._fades_ns(), runs, symbol_scale(self._rig))
