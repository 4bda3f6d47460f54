"""A session as one picture: the floor to scale, and how far each model is off."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ipsys_log.analysis.ground_truth import gather_tracks
from ipsys_log.analysis.places import measured_places
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import TRUTH_TOPIC, Measurement, Rig, Tracks
from ipsys_log.report.accuracy import Accuracy
from ipsys_log.report.errors_figure import count_rows, draw_errors
from ipsys_log.report.figures import picture
from ipsys_log.report.files import write_files
from ipsys_log.report.floor_panel import Scene, draw_floor
from ipsys_log.report.palette import camera_styles
from ipsys_log.runs.provenance import newest_run
from ipsys_log.sinks.selection import rig_in_force

__all__ = ["draw_session"]

_DPI = 100
# Of the floor's axes: how far below the top of the picture, and how long a side.
_TOP_IN = 0.65
_SIDE_IN = 6.3
# A line joins two instants of a track only where a robot can have gone from one to the other.
_STEP_M = 0.5
_GAP_NS = 500_000_000


def draw_session(session: Session, accuracies: Sequence[Accuracy], path: Path) -> None:
    """Draw a session into a picture of about 1400 x 800 pixels.

    On the left the floor to scale: measured places, the error of each held-out one as an arrow
    (exaggerated by the factor that the title states) for the first model, tracks and, where known, the
    truth. On the right every error of every model and camera, in cm.

    Parameters
    ----------
    session : open logs.
    accuracies : from :func:`ipsys_log.report.accuracy.read_accuracy`; none leaves out the right side.
    path : the picture, of the kind that its suffix says, in place of one that is there already.

    Raises
    ------
    IpsysError
        For a session with neither a floor nor places nor tracks.
    """
    scene = _gather(session, accuracies)
    rows = count_rows(accuracies)
    # Rows of text need their height; beyond some 28 of them the picture grows.
    figure = Figure(figsize=(14 if rows else 9, max(8.0, 1.6 + 0.23 * rows)), dpi=_DPI)
    width, height = figure.get_size_inches()
    low_in = height - _TOP_IN - _SIDE_IN
    axes = figure.add_axes((0.65 / width, low_in / height, _SIDE_IN / width, _SIDE_IN / height))
    styles = camera_styles(row.camera for a in accuracies if a.evaluation for row in a.evaluation.cameras)
    draw_floor(axes, scene, styles)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="upper left", ncols=5, fontsize=8, frameon=False,
        bbox_to_anchor=(0.4 / width, (low_in - 0.5) / height),
    )  # fmt: skip
    if rows:
        draw_errors(figure, accuracies, styles, left_in=7.3, top_in=_TOP_IN)
    write_files(path.parent, {path.name: picture(figure, path, _DPI)})


def _gather(session: Session, accuracies: Sequence[Accuracy]) -> Scene:
    evaluated = [accuracy for accuracy in accuracies if accuracy.evaluation is not None]
    runs = [accuracy.run for accuracy in (evaluated or accuracies)]
    run = runs[0] if runs else newest_run(session, Tracks)
    rig = rig_in_force(session, [run] if run else [])
    places, _ = measured_places(session.payloads(session.topics(Measurement)), rig)
    topics = session.topics(Tracks, run) if run else []
    truth = [TRUTH_TOPIC] if TRUTH_TOPIC in session.topics(Tracks) else []
    scene = Scene(
        rig,
        places,
        run,
        evaluated[0].evaluation if evaluated else None,
        _lines(session, topics, rig),
        _lines(session, truth, rig),
    )
    if not (places or scene.tracks or scene.truth or (rig and rig.floor)):
        raise IpsysError(f"{session}: nothing to draw: no floor, measured places or tracks")
    return scene


def _lines(session: Session, topics: Sequence[str], rig: Rig | None) -> dict[str, NDArray[np.float64]]:
    """Ways on the floor by robot, (n, 2) in m, one point an instant, NaN where the line breaks."""
    lines = {}
    for marker_id, track in sorted(gather_tracks(session.messages(topics)).items() if topics else ()):
        # The last of the poses of one instant rests on all cameras.
        times_ns, last = np.unique(track.times_ns[::-1], return_index=True)
        points_m = track.points_m[::-1][last][:, :2]
        broken = (np.linalg.norm(np.diff(points_m, axis=0), axis=1) > _STEP_M) | (np.diff(times_ns) > _GAP_NS)
        name = rig.robot_of(marker_id) if rig else f"marker_{marker_id}"
        lines[name] = np.insert(points_m, np.flatnonzero(broken) + 1, np.nan, axis=0)
    return lines
