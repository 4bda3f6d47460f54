"""Time series of a Rerun recording: disagreement of cameras in mm, and latency of live positions in ms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from ipsys_log.analysis.disagreement import read_disagreement, reference_ids
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import LATENCY
from ipsys_log.sinks.colours import camera_colours, robot_colour
from ipsys_log.sinks.rerun.scene import TIMELINES

# The entities above the series; each has its own plot.
DISAGREEMENT = "series/disagreement"
LATENCY_MS = "series/latency"

_MM_PER_M = 1e3
_NS_PER_MS = 1e6


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

    def is_below(self, entity: str) -> bool:
        """Return whether the series belongs to the plot of an entity."""
        return self.entity.startswith(f"{entity}/")


def read_series(session: Session, runs: Sequence[str]) -> list[Series]:
    """Return the latencies of a log, and the disagreement of cameras in some runs.

    Raises
    ------
    LogError
        A message cannot be read.
    """
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
        times_ns = {TIMELINES[0]: pair.times_ns}
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
            for timeline, column in zip(TIMELINES, stamps, strict=True)
        }
        delays_ns = np.array([m.payload.published - m.payload.received for m in own], dtype=np.float64)
        yield Series(f"{LATENCY_MS}/{camera}", camera, colour, times_ns, delays_ns / _NS_PER_MS)
