"""The Rerun recording of a log: images with markers, floor, positions and tracks, and time series."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import MEASUREMENTS_TOPIC, TRUTH_TOPIC
from ipsys_log.messages.channels import LATENCY, MEASUREMENTS
from ipsys_log.sinks.colours import camera_colours, robot_colour
from ipsys_log.sinks.rerun import scene
from ipsys_log.sinks.rerun.messages import RerunSink, trail_entity
from ipsys_log.sinks.rerun.viewer import show_in_viewer
from ipsys_log.sinks.selection import Shown, choose_runs, fade_ns, rig_in_force
from ipsys_log.statistics.calibration_points import locate_measurements
from ipsys_log.statistics.disagreement import read_disagreement, reference_ids

# The entities above the series; each has its own plot.
DISAGREEMENT = "series/disagreement"
LATENCY_MS = "series/latency"

_MM_PER_M = 1e3
_NS_PER_MS = 1e6
# Frames stay longer than positions: between two calibration points the log may have a gap.
_FRAME_FACTOR = 10
# Titles of the plots, with their units.
_PLOTS = {DISAGREEMENT: "Disagreement of cameras, mm", LATENCY_MS: "Latency, ms"}
# Number of messages between two writes to the viewer: enough for its speed, small in memory.
_BATCH = 1024


def write_recording(session: Session, runs: Sequence[str] = (), save: Path | None = None) -> Shown:
    """Show a session in the Rerun viewer until its window is closed, or save it for the viewer.

    Parameters
    ----------
    session : open logs.
    runs : names of the runs to show; if empty, the newest complete runs.
    save : an ``.rrd`` file to write instead of opening a window; it has its name only when complete.

    Raises
    ------
    IpsysError
        The logs have nothing to show, a run is unknown, or, without ``save``, there is no screen.
    """
    shown = choose_runs(session, runs)
    if not (shown.frames or shown.moving or session.count(MEASUREMENTS_TOPIC)):
        raise IpsysError(
            f"{session}: has nothing to show: no frames, markers, positions or calibration points; "
            "to list its contents: ipsys info"
        )
    if save is None:
        show_in_viewer(lambda write: _stream(session, shown, write))
        return shown
    partial = save.with_name(save.name + ".partial")
    try:
        partial.touch()  # errors of the path are raised by this call, not by Rerun
        _save(session, shown, partial)
        partial.replace(save)
    finally:
        partial.unlink(missing_ok=True)
    return shown


def _name_of(session: Session) -> str:
    return ", ".join(path.stem for path in session.paths)


def _save(session: Session, shown: Shown, path: Path) -> None:
    with scene.open_recording(_name_of(session)) as recording:
        try:
            recording.save(path)
        except RuntimeError as error:
            raise IpsysError(f"{path}: cannot be written: {error}") from error
        _draw(session, shown, recording, lambda: None)


def _stream(session: Session, shown: Shown, write: Callable[[bytes], object]) -> None:
    with scene.open_recording(_name_of(session)) as recording:
        stream = rr.binary_stream(recording)
        _draw(session, shown, recording, lambda: write(stream.read() or b""))


def _draw(session: Session, shown: Shown, recording: rr.RecordingStream, sent: Callable[[], object]) -> None:
    """Draw a whole session; ``sent`` is called repeatedly, and at the end."""
    rig = rig_in_force(session, [run for run in (shown.markers, *shown.runs) if run])
    measurements = session.payloads(session.topics(MEASUREMENTS))
    places, faults = locate_measurements(measurements, rig)
    trails = [trail_entity(run) for run in (*shown.runs, *([None] if TRUTH_TOPIC in shown.moving else []))]
    series = read_series(session, shown.runs)
    sizes_px = _sizes_px(session, shown.cameras)
    has_events = bool(shown.events or faults)
    recording.send_blueprint(scene.layout(shown.cameras, trails, rig, has_events, _plots(series), sizes_px))
    scene.draw_rig(recording, rig)
    scene.draw_places(recording, places, scene.symbol_scale(rig))
    scene.draw_legend(recording)
    draw_series(recording, series)
    for fault in faults:
        recording.log("events/measurements", rr.TextLog(fault, level="WARN"))
    fades = fade_ns(session, shown.frames, _FRAME_FACTOR) | fade_ns(session, shown.moving)
    sink = RerunSink(recording, (*shown.cameras, *shown.others), fades, shown.runs, scene.symbol_scale(rig))
    for number, message in enumerate(session.messages([*shown.frames, *shown.moving, *shown.events])):
        sink(message)
        if number % _BATCH == 0:
            sink.flush()
            sent()
    sink.close()
    sent()


def _plots(series: "Sequence[Series]") -> dict[str, scene.Plot]:
    counts = {entity: sum(one.entity.startswith(f"{entity}/") for one in series) for entity in _PLOTS}
    return {entity: scene.Plot(title, counts[entity]) for entity, title in _PLOTS.items() if counts[entity]}


def _sizes_px(session: Session, cameras: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return the width and height of the frames of the cameras that have intrinsics."""
    topics = {camera: session.calibrations[camera] for camera in cameras if camera in session.calibrations}
    lenses = {camera: next(iter(session.payloads([topic])), None) for camera, topic in topics.items()}
    return {camera: (lens.width, lens.height) for camera, lens in lenses.items() if lens is not None}


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One series of a plot: the entity, its name in the legend, its colour, and its points.

    Attributes
    ----------
    times_ns : by timeline, (n,) instants in ns.
    values : (n,), in the unit of the plot.
    """

    entity: str
    name: str
    colour: tuple[int, int, int]
    times_ns: Mapping[str, NDArray[np.int64]]
    values: NDArray[np.float64]


def read_series(session: Session, runs: Sequence[str]) -> list[Series]:
    """Return the latencies of a log, and the disagreement of cameras in some runs."""
    disagreements = [_disagreements(session, run, several=len(runs) > 1) for run in runs]
    return [*_latencies(session), *(series for of_run in disagreements for series in of_run)]


def draw_series(recording: rr.RecordingStream, series: Sequence[Series]) -> None:
    """Draw each series as points: between two points, a robot may have been unseen."""
    for one in series:
        look = rr.SeriesPoints(colors=[one.colour], names=[one.name], markers=["circle"], marker_sizes=[2.0])
        recording.log(one.entity, look, static=True)
        timelines = [
            rr.TimeColumn(timeline, timestamp=times_ns.astype("datetime64[ns]"))
            for timeline, times_ns in one.times_ns.items()
        ]
        columns = rr.Scalars.columns(scalars=one.values)
        rr.send_columns(one.entity, timelines, columns, recording=recording)


def _disagreements(session: Session, run: str, several: bool) -> Iterator[Series]:
    """Yield the distances of the positions of each pair of cameras, at the instants of the first camera."""
    for number, pair in enumerate(read_disagreement(session, run, reference_ids(session))):
        name = " - ".join(pair.cameras) + (f" ({run})" if several else "")
        entity = f"{DISAGREEMENT}/{run}/{'_and_'.join(pair.cameras)}"
        times_ns = {scene.TIMELINES[0]: pair.times_ns}
        yield Series(entity, name, robot_colour(number), times_ns, _MM_PER_M * pair.lengths_m)


def _latencies(session: Session) -> Iterator[Series]:
    """Yield the time from the arrival of a frame to its published position, for each camera."""
    messages = list(session.messages(session.topics(LATENCY)))
    colours = camera_colours(message.payload.camera for message in messages)
    for camera, colour in colours.items():
        own = [message for message in messages if message.payload.camera == camera]
        stamps = ([m.publish_time_ns for m in own], [m.log_time_ns for m in own])
        times_ns = {
            timeline: np.array(column, dtype=np.int64)
            for timeline, column in zip(scene.TIMELINES, stamps, strict=True)
        }
        delays_ns = np.array([m.payload.published - m.payload.received for m in own], dtype=np.float64)
        yield Series(f"{LATENCY_MS}/{camera}", camera, colour, times_ns, delays_ns / _NS_PER_MS)
