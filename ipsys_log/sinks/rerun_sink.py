"""Messages into a Rerun recording, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr

from ipsys_log.log.topics import run_of_topic
from ipsys_log.messages import (
    TRUTH_TOPIC,
    CompressedImage,
    CompressedVideo,
    Event,
    Markers,
    Message,
    Positions,
    RawImage,
    Track,
    Tracks,
)
from ipsys_log.sinks.fading import Fading
from ipsys_log.sinks.palette import MARKER_COLOUR, TRUTH_COLOUR, camera_colours, robot_colour
from ipsys_log.sinks.rerun_images import rerun_image
from ipsys_log.sinks.rerun_scene import TIMELINES
from ipsys_log.sinks.trails import Segment, Trails

__all__ = ["RerunSink", "trail_entity"]

Entity = tuple[str, ...]

# Rerun counts pixels from the first pixel's corner, OpenCV from its centre.
_CORNER_FROM_CENTRE_PX = 0.5
_HEADING_M = 0.3


def tracks_entity(run: str | None) -> Entity:
    """Where the tracks of a run are drawn; without a run the truth."""
    return ("world", "truth") if run is None else ("world", "runs", run)


def trail_entity(run: str | None) -> str:
    """Path of the trails of a run's robots; without a run of the truth."""
    return "/".join((*tracks_entity(run), "trails"))


class RerunSink:
    """Draw messages, in log order, into a recording.

    What is no longer seen goes away, ``fade_ns`` of its topic after its last message.

    Parameters
    ----------
    recording : an explicit stream, so that nothing of Rerun's global state is touched.
    cameras : all there are, so that each has its colour whoever comes first.
    fade_ns : by topic; without one, the last of a topic stays.
    runs : those drawn. Where there are several, a robot has a colour and a line of text for each.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        cameras: Iterable[str],
        fade_ns: Mapping[str, int],
        runs: Sequence[str] = (),
    ) -> None:
        self._recording = recording
        self._colours = camera_colours(cameras)
        self._fade_ns = fade_ns
        self._runs = tuple(runs)
        self._robots: dict[tuple[str, str], int] = {}
        self._fading = Fading(self._clear)
        self._trails = Trails(self._draw_trail)
        self._draw: dict[type, Callable[[Message], None]] = {
            CompressedImage: self._draw_image,
            CompressedVideo: self._draw_image,
            RawImage: self._draw_image,
            Markers: self._draw_markers,
            Positions: self._draw_positions,
            Tracks: self._draw_tracks,
            Event: self._draw_event,
        }

    def __call__(self, message: Message) -> None:
        """Draw a message; one of a type that is not drawn is passed over."""
        self._fading.advance(message.log_time_ns)
        draw = self._draw.get(type(message.payload))
        if draw is not None:
            draw(message)

    def close(self) -> None:
        """Draw what waited for the next message."""
        self._trails.close()
        self._recording.flush()

    def _log(self, when: Message | Segment, entity: Entity, *what: Any) -> None:
        self._log_at(when.publish_time_ns, when.log_time_ns, entity, *what)

    def _log_at(self, publish_time_ns: int, log_time_ns: int, entity: Entity, *what: Any) -> None:
        # The time is set for each entity: a trail belongs to an earlier instant than what is drawn with it.
        for timeline, time_ns in zip(TIMELINES, (publish_time_ns, log_time_ns), strict=True):
            self._recording.set_time(timeline, timestamp=np.datetime64(time_ns, "ns"))
        self._recording.log(list(entity), *what, strict=True)

    def _clear(self, entity: Entity, publish_time_ns: int, log_time_ns: int) -> None:
        self._log_at(publish_time_ns, log_time_ns, entity, rr.Clear(recursive=True))

    def _draw_image(self, message: Message) -> None:
        entity = ("cameras", str(message.camera), "image")
        try:
            self._log(message, entity, rerun_image(message.payload))
        except ValueError as error:
            self._log(message, entity, rr.Clear(recursive=False))
            self._log(message, ("events", "frames"), rr.TextLog(f"{message.topic}: {error}", level="WARN"))
            return
        self._fading.seen(entity, message, self._fade_ns.get(message.topic, 0))

    def _draw_markers(self, message: Message) -> None:
        entity = ("cameras", str(message.camera), "image", "markers")
        markers = message.payload.markers
        if not markers:
            self._log(message, entity, rr.Clear(recursive=True))
            return
        outlines = [np.vstack([m.corners_px, m.corners_px[:1]]) + _CORNER_FROM_CENTRE_PX for m in markers]
        width = rr.Radius.ui_points(1.5)
        self._log(message, entity, rr.LineStrips2D(outlines, colors=[MARKER_COLOUR], radii=width))
        # A label in the middle would hide the marker; below a point at its lower edge it does not.
        below = [(outline[:4, 0].mean(), outline[:4, 1].max()) for outline in outlines]
        ids = [str(marker.id) for marker in markers]
        dot = rr.Radius.ui_points(0.5)
        points = rr.Points2D(below, labels=ids, colors=[MARKER_COLOUR], radii=dot, show_labels=True)
        self._log(message, (*entity, "ids"), points)
        self._fading.seen(entity, message, self._fade_ns.get(message.topic, 0))

    def _draw_positions(self, message: Message) -> None:
        camera = str(message.camera)
        entity = (*tracks_entity(run_of_topic(message.topic)), "positions", camera)
        positions = message.payload.positions
        if not positions:
            self._log(message, entity, rr.Clear(recursive=True))
            return
        points = rr.Points3D(
            [(p.x_m, p.y_m, p.z_m) for p in positions],
            colors=[self._colours[camera]],
            radii=[0.02],
            labels=[f"{p.id} ({camera})" for p in positions],
            show_labels=False,
        )
        self._log(message, entity, points)
        self._fading.seen(entity, message, self._fade_ns.get(message.topic, 0))

    def _draw_tracks(self, message: Message) -> None:
        run = None if message.topic == TRUTH_TOPIC else run_of_topic(message.topic)
        fade_ns = self._fade_ns.get(message.topic, 0)
        for track in message.payload.tracks:
            entity = (*tracks_entity(run), "robots", track.robot)
            self._draw_robot(message, entity, run, track)
            self._fading.seen(entity, message, fade_ns)
            self._trails.add((run, track.robot), message, (track.x_m, track.y_m, track.z_m), fade_ns)

    def _draw_robot(self, message: Message, entity: Entity, run: str | None, track: Track) -> None:
        colour = self._robot_colour(run, track.robot)
        label = self._label(run, track.robot)
        at = [(track.x_m, track.y_m, track.z_m)]
        radius = 0.03 if run is None else 0.05
        # The truth lies under the track: its name would hide the robot's.
        points = rr.Points3D(at, colors=[colour], radii=[radius], labels=[label], show_labels=run is not None)
        self._log(message, entity, points)
        if track.heading_rad is None:
            self._log(message, (*entity, "heading"), rr.Clear(recursive=False))
            return
        ahead = [(_HEADING_M * np.cos(track.heading_rad), _HEADING_M * np.sin(track.heading_rad), 0.0)]
        arrow = rr.Arrows3D(origins=at, vectors=ahead, colors=[colour], radii=[0.012])
        self._log(message, (*entity, "heading"), arrow)

    def _robot_colour(self, run: str | None, robot: str) -> tuple[int, int, int]:
        if run is None:
            return TRUTH_COLOUR
        return robot_colour(self._robots.setdefault((run, robot), len(self._robots)))

    def _label(self, run: str | None, robot: str) -> str:
        if run is None or len(self._runs) < 2:
            return f"{robot} (truth)" if run is None else robot
        # Runs put a robot at nearly one place: a line further down for each keeps them apart.
        return "\n" * self._runs.index(run) + f"{robot} ({run})"

    def _draw_trail(self, key: tuple[str | None, str], segment: Segment) -> None:
        run, robot = key
        line = rr.LineStrips3D(
            [[segment.start_m, segment.end_m]],
            colors=[self._robot_colour(run, robot)],
            radii=rr.Radius.ui_points(0.75 if run is None else 1.5),
        )
        self._log(segment, (*tracks_entity(run), "trails"), line)

    def _draw_event(self, message: Message) -> None:
        run = run_of_topic(message.topic)
        event = message.payload
        text = rr.TextLog(f"{event.kind.replace('_', ' ')}: {event.text}", level="WARN")
        self._log(message, ("events", run or "recorded"), text)
