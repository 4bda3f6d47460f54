"""Figure of tracks on the floor: their regions of 95 %, and the hand-overs between cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ipsys_log.app.report.figures import save_figure, style_axes
from ipsys_log.app.report.styles import robot_colour, robot_line, shorten
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, Track
from ipsys_log.messages.channels import SMOOTHED_TRACKS, TRACKS
from ipsys_log.sinks.video.floor_map import covariance_ellipse, enlargement

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


def plot_tracks(session: Session, run: str, path: Path) -> None:
    """Write the figure of the tracks of a run; the suffix of the path gives the format."""
    figure = Figure(figsize=(8, 8.4), layout="constrained")
    axes = figure.add_subplot()
    enlarged = draw_tracks(axes, read_drawn_tracks(session, run))
    axes.set_title(
        f"Tracks of run {run}; regions of 95 %, {enlarged} times as large", fontsize=10, loc="left"
    )
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    save_figure(figure, path)
