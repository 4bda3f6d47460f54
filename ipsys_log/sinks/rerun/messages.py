"""Conversion of messages to Rerun entities, one message after the other."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
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
from ipsys_log.sinks.colours import MARKER_COLOUR, TRUTH_COLOUR, camera_colours, robot_colour
from ipsys_log.sinks.rerun.scene import TIMELINES, Fading, Segment, Trails
from ipsys_log.vision.bodies import track_rotation

# Colour model and channels by pixel encoding, all with 8 bits.
_RAW = {
    "mono8": (rr.ColorModel.L, 1),
    "8UC1": (rr.ColorModel.L, 1),
    "rgb8": (rr.ColorModel.RGB, 3),
    "bgr8": (rr.ColorModel.BGR, 3),
    "8UC3": (rr.ColorModel.BGR, 3),
    "rgba8": (rr.ColorModel.RGBA, 4),
    "bgra8": (rr.ColorModel.BGRA, 4),
}
_CODECS = {"h264": rr.VideoCodec.H264, "h265": rr.VideoCodec.H265}
# Frames of all cameras that wait for their batch: larger batches are not faster.
_MOST_WAITING_BYTES = 16 << 20

Entity = tuple[str, ...]
Kind = Any  # a Rerun archetype, such as rr.Points3D
Fields = Mapping[str, Any]


def encoded_frame(frame: CompressedImage | CompressedVideo) -> tuple[Kind, Fields]:
    """Return the archetype of a frame and its fields, of one row; nothing is decoded or encoded again.

    Raises
    ------
    ValueError
        The frame is no image that can be drawn; the text gives the reason.
    """
    if isinstance(frame, CompressedVideo):
        if frame.format not in _CODECS:
            raise ValueError(f"video format {frame.format!r} cannot be drawn (only {', '.join(_CODECS)})")
        return rr.VideoStream, {"codec": [_CODECS[frame.format]], "sample": [frame.data]}
    if frame.data[:3] == b"\xff\xd8\xff":
        return rr.EncodedImage, {"blob": [frame.data], "media_type": ["image/jpeg"]}
    if frame.data[:8] == b"\x89PNG\r\n\x1a\n":
        return rr.EncodedImage, {"blob": [frame.data], "media_type": ["image/png"]}
    raise ValueError(f"{len(frame.data)} bytes are not a JPEG or PNG ({frame.format or 'no format given'})")


def raw_image(frame: RawImage) -> rr.Image:
    """Return a frame of pixels without the padding of its rows.

    Raises
    ------
    ValueError
        The pixel encoding cannot be drawn, or bytes are missing.
    """
    if frame.encoding not in _RAW:
        raise ValueError(f"pixel encoding {frame.encoding!r} cannot be drawn (only {', '.join(_RAW)})")
    model, channels = _RAW[frame.encoding]
    used = frame.width * channels
    if min(frame.width, frame.height) < 1 or frame.step < used or len(frame.data) < frame.step * frame.height:
        raise ValueError(f"{len(frame.data)} bytes are too few for {frame.width} x {frame.height}")
    rows = np.frombuffer(frame.data, np.uint8, frame.step * frame.height).reshape(frame.height, frame.step)
    pixels = np.ascontiguousarray(rows[:, :used]).reshape(frame.height, frame.width, channels)
    return rr.Image(pixels[..., 0] if channels == 1 else pixels, color_model=model)


# Rerun counts pixels from the first pixel's corner, OpenCV from its centre.
_CORNER_FROM_CENTRE_PX = 0.5
_HEADING_M = 0.3
_MOST_ROBOTS = 5000  # of all runs together: an ArUco dictionary has 1000 markers at most
_LINE, _THIN, _DOT = (rr.Radius.ui_points(width) for width in (1.5, 0.75, 0.5))


def tracks_entity(run: str | None) -> Entity:
    """Return the entity path of the tracks of a run; without a run, that of the ground truth."""
    return ("world", "truth") if run is None else ("world", "runs", run)


def trail_entity(run: str | None) -> str:
    """Return the path of the trails of a run's robots; without a run, that of the ground truth."""
    return "/".join((*tracks_entity(run), "trails"))


class _Look(NamedTuple):
    """The look of an entity, the publish time from which it is valid, and the time of its last drawing.

    Without a key the look is unknown: the entity is drawn again.
    """

    key: str | None
    since_ns: int
    last_ns: int
    is_drawn: bool = True


_NO_LOOK = _Look(None, 0, 0, is_drawn=False)
# Entities that may exist below an entity that is cleared.
_PARTS = (("ids",), ("heading",), ("markers",), ("markers", "ids"))


class RerunSink:
    """A sink that draws messages, in log order, into a recording.

    An entity that is no longer seen is cleared, ``fade_ns`` of its topic after its last message.

    Parameters
    ----------
    recording : an explicit stream, so that Rerun's global state is not changed.
    cameras : all cameras; each camera has its colour independent of the order of the messages.
    fade_ns : by topic; the last message of a topic without an entry stays.
    runs : the runs to draw. With several runs, a robot has a colour and a line of text for each run.
    scale : factor of the size of points and arrows on the floor.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        cameras: Iterable[str],
        fade_ns: Mapping[str, int],
        runs: Sequence[str] = (),
        scale: float = 1.0,
    ) -> None:
        self._recording = recording
        self._colours = camera_colours(cameras)
        self._fade_ns = fade_ns
        self._runs = tuple(runs)
        self._scale = scale
        self._robots: dict[tuple[str | None, str], int] = {}
        self._waiting: dict[Entity, tuple[Kind, list[tuple[Message | Segment, Fields]]]] = {}
        self._waiting_bytes = 0
        self._looks: dict[Entity, _Look] = {}
        self._fading = Fading(self._clear)
        self._trails = Trails(self._draw_segment)
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
        """Draw a message; ignore a message of a type that is not drawn."""
        self._fading.advance(message.log_time_ns)
        draw = self._draw.get(type(message.payload))
        if draw is not None:
            draw(message)

    def flush(self) -> None:
        """Draw the waiting rows: drawing many rows of an entity at once is many times faster."""
        for entity in list(self._waiting):
            self._send(entity)
        self._waiting_bytes = 0

    def close(self) -> None:
        """Draw all waiting rows."""
        self._trails.close()
        self.flush()
        self._recording.flush()

    def _log(self, message: Message, entity: Entity, *what: Any) -> None:
        self._log_at(message.publish_time_ns, message.log_time_ns, entity, *what)

    def _log_at(self, publish_time_ns: int, log_time_ns: int, entity: Entity, *what: Any) -> None:
        # The time is set for each entity: a trail is older than the other entities of its message.
        for timeline, time_ns in zip(TIMELINES, (publish_time_ns, log_time_ns), strict=True):
            self._recording.set_time(timeline, timestamp=np.datetime64(time_ns, "ns"))
        self._recording.log(list(entity), *what, strict=True)

    def _log_moved(self, message: Message, entity: Entity, kind: Kind, moved: Fields, look: Fields) -> None:
        """Draw the position of an entity; draw its look only if it is new: this takes the most time."""
        key, time_ns = str(look), message.publish_time_ns
        before = self._looks.get(entity, _NO_LOOK)
        last_ns, is_late = max(before.last_ns, time_ns), time_ns < before.since_ns
        if key == before.key and not is_late:
            self._looks[entity] = before._replace(last_ns=last_ns)
            self._add(message, entity, kind, moved)
            return
        # After a late message, the newest appearance is not known.
        now = _Look(None, before.since_ns, last_ns) if is_late else _Look(key, time_ns, last_ns)
        self._looks[entity] = now
        self._send(entity)
        self._log(message, entity, kind.from_fields(**moved, **look))

    def _add(self, when: Message | Segment, entity: Entity, kind: Kind, fields: Fields) -> None:
        self._waiting.setdefault(entity, (kind, []))[1].append((when, fields))

    def _send(self, entity: Entity) -> None:
        """Draw the waiting rows of an entity."""
        if entity not in self._waiting:
            return
        kind, rows = self._waiting.pop(entity)
        times_ns = zip(*((when.publish_time_ns, when.log_time_ns) for when, _ in rows), strict=True)
        timelines = [
            rr.TimeColumn(timeline, timestamp=np.array(column_ns, dtype="datetime64[ns]"))
            for timeline, column_ns in zip(TIMELINES, times_ns, strict=True)
        ]
        names = rows[0][1]
        fields = {name: [item for _, row in rows for item in row[name]] for name in names}
        lengths = [len(row[next(iter(names))]) for _, row in rows]
        columns = kind.columns(**fields).partition(lengths)
        path = rr.new_entity_path(list(entity))
        rr.send_columns(path, timelines, columns, recording=self._recording)

    def _clear_now(self, message: Message, entity: Entity) -> None:
        """Clear an entity, unless a later message has drawn it already."""
        look = self._looks.get(entity, _NO_LOOK)
        if look.is_drawn and message.publish_time_ns >= look.last_ns:
            self._clear(entity, message.publish_time_ns, message.log_time_ns)

    def _clear(self, entity: Entity, publish_time_ns: int, log_time_ns: int) -> None:
        for part in (entity, *((*entity, *below) for below in _PARTS)):
            if part in self._looks:
                self._looks[part] = _Look(None, publish_time_ns, publish_time_ns, is_drawn=False)
            self._send(part)
        self._log_at(publish_time_ns, log_time_ns, entity, rr.Clear(recursive=True))

    def _draw_image(self, message: Message) -> None:
        entity = ("cameras", str(message.camera), "image")
        try:
            if isinstance(message.payload, RawImage):
                self._log(message, entity, raw_image(message.payload))
            else:
                self._add_frame(message, entity, *encoded_frame(message.payload))
        except ValueError as error:
            self._send(entity)
            self._log(message, entity, rr.Clear(recursive=False))
            self._log(message, ("events", "frames"), rr.TextLog(f"{message.topic}: {error}", level="WARN"))
            return
        self._fading.seen(entity, message, self._fade_ns.get(message.topic, 0))

    def _add_frame(self, message: Message, entity: Entity, kind: Kind, fields: Fields) -> None:
        if self._waiting.get(entity, (kind,))[0] is not kind:
            self._send(entity)
        self._add(message, entity, kind, fields)
        self._waiting_bytes += len(message.payload.data)
        if self._waiting_bytes >= _MOST_WAITING_BYTES:
            self.flush()
            # The queue of Rerun has no limit: without this wait, a slow disk fills the memory.
            self._recording.flush()

    def _draw_markers(self, message: Message) -> None:
        entity = ("cameras", str(message.camera), "image", "markers")
        markers = message.payload.markers
        if not markers:
            self._clear_now(message, entity)
            return
        outlines = [np.vstack([m.corners_px, m.corners_px[:1]]) + _CORNER_FROM_CENTRE_PX for m in markers]
        line = {"colors": [MARKER_COLOUR], "radii": [_LINE]}
        self._log_moved(message, entity, rr.LineStrips2D, {"strips": outlines}, line)
        # A label in the centre would hide the marker; a label below its lower edge does not.
        below = [(outline[:4, 0].mean(), outline[:4, 1].max()) for outline in outlines]
        ids = [str(marker.id) for marker in markers]
        label = {"labels": ids, "colors": [MARKER_COLOUR], "radii": [_DOT], "show_labels": [True]}
        self._log_moved(message, (*entity, "ids"), rr.Points2D, {"positions": below}, label)
        self._fading.seen(entity, message, self._fade_ns.get(message.topic, 0))

    def _draw_positions(self, message: Message) -> None:
        camera = str(message.camera)
        entity = (*tracks_entity(run_of_topic(message.topic)), "positions", camera)
        positions = message.payload.positions
        if not positions:
            self._clear_now(message, entity)
            return
        look = {
            "colors": [self._colours[camera]],
            "radii": [0.02 * self._scale],
            "labels": [f"{p.id} ({camera})" for p in positions],
            "show_labels": [False],
        }
        points = [(p.x_m, p.y_m, p.z_m) for p in positions]
        self._log_moved(message, entity, rr.Points3D, {"positions": points}, look)
        self._fading.seen(entity, message, self._fade_ns.get(message.topic, 0))

    def _draw_tracks(self, message: Message) -> None:
        run = None if message.topic == TRUTH_TOPIC else run_of_topic(message.topic)
        fade_ns = self._fade_ns.get(message.topic, 0)
        for track in message.payload.tracks:
            entity = (*tracks_entity(run), "robots", track.robot)
            self._draw_robot(message, entity, run, track)
            self._fading.seen(entity, message, fade_ns)
            # A trail shows what cameras saw, not predictions.
            if track.coasting_ns is None:
                self._trails.add((run, track.robot), message, (track.x_m, track.y_m, track.z_m), fade_ns)

    def _draw_robot(self, message: Message, entity: Entity, run: str | None, track: Track) -> None:
        colour = self._robot_colour(run, track.robot)
        label = self._label(run, track.robot)
        positions = [(track.x_m, track.y_m, track.z_m)]
        radius = (0.03 if run is None else 0.05) * self._scale
        # The ground truth lies under the track: its name would hide the robot's name.
        look = {"colors": [colour], "radii": [radius], "labels": [label], "show_labels": [run is not None]}
        self._log_moved(message, entity, rr.Points3D, {"positions": positions}, look)
        heading = (*entity, "heading")
        if track.heading_rad is None:
            self._clear_now(message, heading)
            return
        length_m = _HEADING_M * self._scale
        forward, _, up = length_m * track_rotation(track).T
        # A second arrow shows the tilt of a robot that is not level.
        arrows = [forward] if track.rotation_rad is None else [forward, up / 2]
        arrow = {"origins": positions * len(arrows), "vectors": arrows}
        arrow_look = {"colors": [colour], "radii": [0.012 * self._scale]}
        self._log_moved(message, heading, rr.Arrows3D, arrow, arrow_look)

    def _robot_colour(self, run: str | None, robot: str) -> tuple[int, int, int]:
        if (run, robot) not in self._robots:
            if len(self._robots) == _MOST_ROBOTS:
                raise IpsysError(
                    f"the tracks have more than {_MOST_ROBOTS} robots; the viewer cannot draw so many"
                )
            self._robots[run, robot] = sum(of_run is not None for of_run, _ in self._robots)
        return TRUTH_COLOUR if run is None else robot_colour(self._robots[run, robot])

    def _label(self, run: str | None, robot: str) -> str:
        if run is None or len(self._runs) < 2:
            return f"{robot} (truth)" if run is None else robot
        # All runs have a robot at nearly the same position: each run's label starts one line lower.
        return "\n" * self._runs.index(run) + f"{robot} ({run})"

    def _draw_segment(self, key: tuple[str | None, str], segment: Segment) -> None:
        run, robot = key
        line = {
            "strips": [[segment.start_m, segment.end_m]],
            "colors": [self._robot_colour(run, robot)],
            "radii": [_THIN if run is None else _LINE],
        }
        self._add(segment, (*tracks_entity(run), "trails"), rr.LineStrips3D, line)

    def _draw_event(self, message: Message) -> None:
        run = run_of_topic(message.topic)
        event = message.payload
        text = rr.TextLog(f"{event.kind.replace('_', ' ')}: {event.text}", level="WARN")
        self._log(message, ("events", run or "recorded"), text)
