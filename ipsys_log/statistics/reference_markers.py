"""Mean corners of the reference markers of a log, in short windows over its duration."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from ipsys_log.errors import LogError
from ipsys_log.log.codec import schema_name
from ipsys_log.log.columns import read_columns
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Markers
from ipsys_log.messages.channels import MARKERS
from ipsys_log.statistics.drift import MeanCorners
from ipsys_log.units import NS_PER_S

# A log has at most so many windows. A longer log is read in part: a camera that has moved stays there.
_MOST_WINDOWS = 60
# Windows follow each other at least this long,
_LEAST_NS = NS_PER_S
# and are at most this long: so much of a longer log is read.
_LONGEST_NS = 2 * NS_PER_S
# With fewer frames, one hand before a marker changes the median.
_FEWEST_FRAMES = 3
_FARTHEST_PX = 1e5


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The reference markers in a part of a log: mean corners by camera and marker id."""

    start_ns: int
    end_ns: int
    corners: Mapping[str, Mapping[int, MeanCorners]]


def read_windows(session: Session, run: str, ids: Collection[int]) -> list[Window]:
    """Return the windows of a log, in order of time; windows without a reference marker are left out.

    The mean of a corner is the median over the frames: a hand in front of the marker has no effect.

    Parameters
    ----------
    session : an open log.
    run : the run with the markers.
    ids : ids of the reference markers.
    """
    topics = session.topics(MARKERS, run)
    times = [r.times(topic) for r in session.readers for topic in topics if topic in r.channels]
    times = [one for one in times if len(one)]
    if not times:
        return []
    first_ns, last_ns = min(int(one[0]) for one in times), max(int(one[-1]) for one in times) + 1
    step_ns = max(_LEAST_NS, -(-(last_ns - first_ns) // _MOST_WINDOWS))
    windows = []
    for start_ns in range(first_ns, last_ns, step_ns):
        end_ns = min(start_ns + min(step_ns, _LONGEST_NS), last_ns)
        corners = _mean_corners(session, topics, ids, start_ns, end_ns)
        if corners:
            windows.append(Window(start_ns, end_ns, corners))
    return windows


def _mean_corners(
    session: Session, topics: Collection[str], ids: Collection[int], start_ns: int, end_ns: int
) -> dict[str, dict[int, MeanCorners]]:
    messages: dict[str, list[bytes]] = {}
    for topic, _, _, data in session.encoded(topics, start_ns, end_ns):
        messages.setdefault(topic, []).append(data)
    means: dict[str, dict[int, MeanCorners]] = {}
    parts = session.part_counter()
    for topic, encoded in messages.items():
        columns = read_columns(schema_name(Markers), encoded, ("id", "corners_px"), parts)
        seen, corners_px = columns.fields["id"].values, columns.fields["corners_px"].values
        if corners_px.shape[1] not in (0, 8):
            raise LogError(f"{session}: {topic} has markers with other than four corners")
        # A comparison with NaN is False.
        valid = ~columns.fields["corners_px"].missing & (np.abs(corners_px) < _FARTHEST_PX).all(axis=1)
        for marker_id in sorted(ids):
            rows = (seen == marker_id) & valid
            if rows.sum() >= _FEWEST_FRAMES:
                middle = np.median(corners_px[rows], axis=0).reshape(4, 2)
                own = means.setdefault(str(camera_of_topic(topic)), {})
                own[marker_id] = MeanCorners(middle, int(rows.sum()))
    return means


def average_windows(windows: Collection[Window], camera: str) -> dict[int, MeanCorners]:
    """Return the mean corners of a camera's reference markers over some windows, by marker id."""
    means = {}
    for marker_id in sorted({one for window in windows for one in window.corners.get(camera, {})}):
        own = [w.corners[camera][marker_id] for w in windows if marker_id in w.corners.get(camera, {})]
        counts = [mean.count for mean in own]
        corners_px = np.average([mean.corners_px for mean in own], axis=0, weights=counts)
        means[marker_id] = MeanCorners(np.asarray(corners_px), sum(counts))
    return means


def image_sizes(session: Session, run: str) -> dict[str, tuple[int, int]]:
    """Return the width and height of the images of each camera with markers, in px."""
    sizes = {}
    for topic in session.topics(MARKERS, run):
        frame: Markers = next(session.messages([topic])).payload
        sizes[str(camera_of_topic(topic))] = frame.width, frame.height
    return sizes
