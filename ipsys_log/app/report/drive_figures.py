"""Figures of drives: tracks on the floor, and six instants of a robot run (figure 12 of the paper)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from ipsys_log.app.report.figures import new_figure, style_axes
from ipsys_log.app.report.floor_figure import draw_ground
from ipsys_log.app.report.styles import NOTE, TEST, robot_colour, robot_line, shorten
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CompressedImage, Marker, Markers, Rig, Track
from ipsys_log.messages.channels import MARKERS, RIG, SMOOTHED_TRACKS, TRACKS
from ipsys_log.sinks.video.floor_map import covariance_ellipse, enlargement
from ipsys_log.tools.robot_run import RobotResult, RobotRunResult
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import check_encoded

# Breaks of a line: a longer step or gap than this.
_STEP_M, _GAP_NS = 0.5, 200_000_000
# One region is drawn after this way. Regions are enlarged, so that a usual one has about this radius.
_EVERY_M, _RADIUS_M = 0.25, 0.06
_DPI = 100


@dataclass(frozen=True, slots=True, eq=False)
class DrawnTrack:
    """The track of a robot on the floor.

    Attributes
    ----------
    line_m : (n, 2), NaN at a break.
    regions : points (k, 2) and covariances (k, 2, 2) along the track; k is 0 without covariances.
    hand_overs_m : (h, 2), poses at which the cameras of the last 100 ms change.
    """

    line_m: Array
    regions: tuple[Array, Array]
    hand_overs_m: Array


def read_drawn_tracks(session: Session, run: str) -> dict[str, DrawnTrack]:
    """Return the tracks of a run by robot: smoothed tracks if there are any, otherwise tracks."""
    topics = session.topics(SMOOTHED_TRACKS, run) or session.topics(TRACKS, run)
    rows: dict[str, dict[int, Track]] = {}
    for message in session.messages(topics) if topics else ():
        for track in message.payload.tracks:
            if track.coasting_ns is None:
                rows.setdefault(track.robot, {})[message.payload.timestamp] = track
    return {robot: _drawn(dict(sorted(own.items()))) for robot, own in sorted(rows.items())}


def _drawn(rows: dict[int, Track]) -> DrawnTrack:
    times_ns, tracks = np.array(list(rows)), list(rows.values())
    points_m = np.array([(track.x_m, track.y_m) for track in tracks])
    way_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    broken = (way_m > _STEP_M) | (np.diff(times_ns) > _GAP_NS)
    cameras = [track.cameras for track in tracks]
    changes = [n for n in range(1, len(tracks)) if cameras[n] != cameras[n - 1] and not broken[n - 1]]
    places = np.floor(np.concatenate([[0.0], np.cumsum(way_m)]) / _EVERY_M)
    marked = [n for n in np.unique(places, return_index=True)[1] if tracks[n].covariance_m2 is not None]
    return DrawnTrack(
        np.insert(points_m, np.flatnonzero(broken) + 1, np.nan, axis=0),
        (points_m[marked], _covariances([tracks[n] for n in marked])),
        points_m[changes],
    )


def _covariances(tracks: Sequence[Track]) -> Array:
    found = [track.covariance_m2[:2, :2] for track in tracks if track.covariance_m2 is not None]
    return np.array(found).reshape(-1, 2, 2)


def draw_tracks(axes: Axes, tracks: dict[str, DrawnTrack]) -> int:
    """Draw tracks, their enlarged regions of 95 % and their hand-overs; return the enlargement."""
    regions = np.concatenate([track.regions[1] for track in tracks.values()] or [np.empty((0, 2, 2))])
    enlarged = enlargement(regions, _RADIUS_M)
    for number, (robot, track) in enumerate(tracks.items()):
        colour = robot_colour(number)
        axes.plot(*track.line_m.T, robot_line(number), color=colour, lw=1.2, label=shorten(robot))
        for centre_m, covariance_m2 in zip(*track.regions, strict=True):
            axes.add_patch(_ellipse(centre_m, covariance_m2, enlarged, colour))
    hand_overs_m = np.concatenate([track.hand_overs_m for track in tracks.values()] or [np.empty((0, 2))])
    axes.plot(*hand_overs_m.T, "o", ms=3.5, mfc="white", mec="black", mew=0.8, label="hand-over")
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
    axes.autoscale_view()
    style_axes(axes)
    return enlarged


def _ellipse(centre_m: Array, covariance_m2: Array, enlarged: int, colour: str) -> Ellipse:
    major_m, minor_m, angle_rad = covariance_ellipse(covariance_m2)
    size_m = 2 * enlarged * major_m, 2 * enlarged * minor_m
    return Ellipse(
        (float(centre_m[0]), float(centre_m[1])), *size_m, angle=float(np.degrees(angle_rad)), lw=0.6,
        ec=colour, fc=colour, alpha=0.35,
    )  # fmt: skip


Image = NDArray[np.uint8]

_WIDTH_PX = 640
# The log time of a frame is later than its instant, by the delay of its camera and of a busy machine.
_LATE_NS = 3 * NS_PER_S
_GREY, _GAP_PX = 235, 4
_TEXT = {
    "va": "top",
    "color": "white",
    "bbox": {"facecolor": "black", "edgecolor": "none", "pad": 3, "alpha": 0.75},
}


class _Panel(NamedTuple):
    """An instant of the drive, and the title of its panel."""

    title: str
    time_ns: int


def draw_panels(session: Session, result: RobotRunResult, robot: RobotResult) -> Figure:
    """Draw six instants of a robot's drive, as figure 12 of the paper.

    A panel has the images of all cameras at one instant, the last camera of the rig on top. The text at its
    top left is the position that the controller received last. A circle is around the robot. A camera without
    a frame at this instant is grey.
    """
    panels = _panels(result, robot)
    figure = Figure(figsize=(12.0, 14.0), layout="constrained")
    cameras = _ordered(session)
    for axes, panel, letter in zip(figure.subplots(2, 3).flat, panels, "abcdef", strict=True):
        tops_px, picture = _stack([_small(_frame_at(session, topic, panel.time_ns)) for _, topic in cameras])
        axes.imshow(picture)
        for (camera, topic), top_px in zip(cameras, tops_px, strict=True):
            _outline(axes, session, robot, camera, _frame_at(session, topic, panel.time_ns), top_px)
            axes.text(_WIDTH_PX - 8, top_px + 12, shorten(camera), **_TEXT, ha="right", fontsize=9)
        axes.set_axis_off()
        at_s = (panel.time_ns - result.start_ns) / NS_PER_S
        axes.set_title(f"({letter}) {panel.title}, {at_s:.1f} s", fontsize=12, loc="left")
        axes.text(8, 12, _position_text(robot, panel.time_ns), **_TEXT, fontsize=11)
    return figure


def _panels(result: RobotRunResult, robot: RobotResult) -> list[_Panel]:
    """Return the instants of the paper: the start, the way to P2, P2, the last but one, the way, the last."""
    reached = {point.number: point for point in robot.reached}
    last = len(robot.path)

    def at(number: int) -> _Panel:
        point = reached.get(number)
        time_ns = result.end_ns if point is None else (point.start_ns + point.end_ns) // 2
        return _Panel(
            f"at P{number} ({robot.path[number - 1].x_m:g}, {robot.path[number - 1].y_m:g})", time_ns
        )

    def between(number: int) -> _Panel:
        first, second = reached.get(number), reached.get(number + 1)
        begin_ns = result.start_ns if first is None else first.end_ns
        end_ns = result.end_ns if second is None else second.start_ns
        return _Panel(f"from P{number} to P{number + 1}", _halfway_ns(robot, number, begin_ns, end_ns))

    start = _Panel("start, near P1", result.start_ns + NS_PER_S // 2)
    return [start, between(1), at(2), at(max(last - 1, 2)), between(last - 1), at(last)]


def _halfway_ns(robot: RobotResult, number: int, begin_ns: int, end_ns: int) -> int:
    """Return the time at which a robot is nearest to the middle of the way to the next waypoint."""
    times_ns = robot.received.times_ns
    within = (times_ns >= begin_ns) & (times_ns <= end_ns)
    if not within.any():
        return (begin_ns + end_ns) // 2
    places = [robot.path[number - 1], robot.path[number]]
    middle_m = np.mean([(place.x_m, place.y_m) for place in places], axis=0)
    left_m = np.linalg.norm(robot.received.points_m[within] - middle_m, axis=1)
    return int(times_ns[within][left_m.argmin()])


def _position_text(robot: RobotResult, time_ns: int) -> str:
    before = np.flatnonzero(robot.received.times_ns <= time_ns)
    if not len(before):
        return "no position"
    x_m, y_m = robot.received.points_m[before[-1]].tolist()
    return rf"$\hat{{X}}_{{w0}}$ = {x_m:.3f} m   $\hat{{Y}}_{{w0}}$ = {y_m:.3f} m"


def _stack(images: Sequence[Image | None]) -> tuple[list[int], Image]:
    """Return images one above the other, and the first row of each; a missing image is grey."""
    empty = np.full((_WIDTH_PX * 9 // 16, _WIDTH_PX, 3), _GREY, dtype=np.uint8)
    gap = np.full((_GAP_PX, _WIDTH_PX, 3), 255, dtype=np.uint8)
    tops_px, parts, rows = [], [], 0
    for image in images:
        part = empty if image is None else image
        tops_px.append(rows)
        parts += [part, gap]
        rows += len(part) + _GAP_PX
    return tops_px, np.vstack(parts[:-1])


def _ordered(session: Session) -> list[tuple[str, str]]:
    """Return names and topics of the cameras: in the simulated lab, the world's y points up in the figure."""
    rig = _rig(session)
    names = [camera.name for camera in rig.cameras] if rig else []
    known = [name for name in reversed(names) if name in session.images]
    return [(name, session.images[name]) for name in [*known, *sorted(set(session.images) - set(known))]]


def _frame_at(session: Session, topic: str, time_ns: int) -> CompressedImage | None:
    """Return the first frame of a camera at a time or up to half a second later; None without a frame."""
    for message in session.messages([topic], time_ns, time_ns + _LATE_NS):
        late_ns = message.publish_time_ns - time_ns
        if isinstance(message.payload, CompressedImage) and 0 <= late_ns <= NS_PER_S // 2:
            return message.payload
    return None


def _small(frame: CompressedImage | None) -> Image | None:
    if frame is None:
        return None
    check_encoded(frame.data)
    image = cv2.imdecode(np.frombuffer(frame.data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
    small = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _outline(
    axes: Axes, session: Session, robot: RobotResult, camera: str, frame: CompressedImage | None, top_px: int
) -> None:
    """Draw a circle around the marker of the robot in the image of a camera."""
    scale = _scale(session, camera)
    if frame is None or scale is None:
        return
    rigs: list[Rig] = session.payloads(session.topics(RIG))
    ids = {marker.id for rig in rigs for marker in rig.markers if marker.robot == robot.name}
    for marker in _markers_at(session, camera, frame.timestamp):
        if marker.id in ids:
            x_px, y_px = (marker.corners_px.mean(axis=0) * scale).tolist()
            axes.plot(x_px, y_px + top_px, "o", ms=26, mfc="none", mec=robot_colour(0), mew=2)


def _scale(session: Session, camera: str) -> float | None:
    topic = session.calibrations.get(camera)
    if topic is None:
        return None
    return float(_WIDTH_PX / session.payloads([topic])[-1].width)


def _markers_at(session: Session, camera: str, time_ns: int) -> list[Marker]:
    """Return the markers that were detected in a frame, in any run."""
    for run in sorted(session.run_names()):
        topic = MARKERS.topic_of(run, camera)
        if topic not in session.topics(MARKERS, run):
            continue
        for message in session.messages([topic], time_ns, time_ns + _LATE_NS):
            if message.publish_time_ns == time_ns and isinstance(message.payload, Markers):
                return list(message.payload.markers)
    return []


def _rig(session: Session) -> Rig | None:
    rigs: list[Rig] = session.payloads(session.topics(RIG))
    return rigs[-1] if rigs else None


def draw_drive(session: Session, robot: RobotResult) -> Figure:
    """Draw the floor with the true path of a robot, its received positions and its waypoints."""
    figure, axes = new_figure(5.2)
    places_m = np.array([(place.x_m, place.y_m) for place in robot.path])
    draw_ground(axes, _rig(session), [places_m])
    if robot.true is not None:
        axes.plot(*robot.true.points_m[:, :2].T, color="black", lw=1.0, label="true path")
    axes.plot(*robot.received.points_m.T, ".", color=robot_colour(0), ms=3, label="received positions")
    axes.plot(*places_m.T, "x", color=TEST, ms=9, mew=1.8, ls="none", label="waypoints")
    for number, place in enumerate(places_m, 1):
        axes.annotate(f"P{number}", place, (6, -12), textcoords="offset points", color=TEST, fontsize=9)
    _finish_map(axes)
    return figure


def draw_paths(session: Session, result: RobotRunResult) -> Figure:
    """Draw the floor with the paths of all robots, and the time in s at which each reached its waypoints."""
    figure, axes = new_figure(5.2)
    places_m = [np.array([(place.x_m, place.y_m) for place in robot.path]) for robot in result.robots]
    draw_ground(axes, _rig(session), places_m)
    for number, (robot, at_m) in enumerate(zip(result.robots, places_m, strict=True)):
        colour, path = robot_colour(number), robot.received if robot.true is None else robot.true
        axes.plot(*path.points_m[:, :2].T, color=colour, lw=1.4, label=robot.name)
        axes.plot(*at_m.T, "x", color=colour, ms=8, mew=1.8)
        for point in robot.reached:
            at_s = (point.start_ns - result.start_ns) / NS_PER_S
            _label(axes, at_m[point.number - 1], f"{at_s:.0f} s", colour)
    _finish_map(axes)
    return figure


def _finish_map(axes: Axes) -> None:
    axes.tick_params(colors=NOTE)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, fontsize=8, frameon=False)


def _label(axes: Axes, where_m: NDArray[np.float64], text: str, colour: str) -> None:
    """Write a text beside a point, on the side of the middle of the floor."""
    side = 1 if where_m[0] < np.mean(axes.get_xlim()) else -1
    axes.annotate(
        text, (float(where_m[0]), float(where_m[1])), (6 * side, 5), textcoords="offset points",
        ha="left" if side > 0 else "right", color=colour, fontsize=9,
    )  # fmt: skip
