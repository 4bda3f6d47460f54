"""Frames of a carried body: which of them show which of its markers, and a choice of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Marker, Markers, Message
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.square_pose import is_convex

# More frames take longer than seconds, and the noise is no longer the largest error.
_MOST_FRAMES = 300
_LEAST_FRAMES = 5
# Frames that are at most so far apart are linked by the usual acceleration of a carried body.
LINKED_S = 0.1


class BodyFrame(NamedTuple):
    """The markers of a body in a frame, and the times of their exposures by the common clock."""

    camera: str
    markers: list[Marker]
    times_ns: list[int]

    @property
    def time_ns(self) -> int:
        return sum(self.times_ns) // len(self.times_ns)

    def of(self, ids: Sequence[int]) -> BodyFrame:
        rows = [n for n, marker in enumerate(self.markers) if marker.id in ids]
        return BodyFrame(self.camera, [self.markers[n] for n in rows], [self.times_ns[n] for n in rows])


def read_frames(
    cameras: Mapping[str, JointModel], ids: Sequence[int], messages: Iterable[Message]
) -> list[BodyFrame]:
    """Return the frames with markers of the body, in order of time, at the common clock of the cameras."""
    frames = []
    for message in messages:
        model = cameras.get(str(message.camera))
        if model is None or not isinstance(message.payload, Markers):
            continue
        frame = BodyFrame(str(message.camera), [], [])
        for marker in message.payload.markers:
            if marker.id in ids and is_convex(undistort(marker.corners_px, model.calibration)):
                later_s = float(marker.corners_px[:, 1].mean()) * model.row_time_s + model.clock_s
                later_ns = (marker.time_offset_ns or 0) + round(later_s * NS_PER_S)
                frame.markers.append(marker)
                frame.times_ns.append(message.publish_time_ns + later_ns)
        frames.append(frame)
    return sorted((frame for frame in frames if frame.markers), key=lambda frame: frame.time_ns)


def determined_markers(
    robot: str, ids: Sequence[int], frames: Sequence[BodyFrame]
) -> tuple[list[int], list[str]]:
    """Return the ids of the markers whose poses are determined, and the reasons why others are not."""
    together = _pairs(frames)
    counts = {i: sum(i in [m.id for m in frame.markers] for frame in frames) for i in ids}
    often = [i for i in ids if counts[i] >= _LEAST_FRAMES]
    remarks = [
        f"marker {i} of {robot} is in {counts[i]} frames together with another one; {_LEAST_FRAMES} are "
        "needed. Turn it to a camera while you carry the body"
        for i in ids
        if i not in often
    ]
    linked, waiting = set[int](), [ids[0]]
    while waiting:
        i = waiting.pop()
        linked.add(i)
        waiting += [j for j in often if j not in linked and len(together.get((min(i, j), max(i, j)), ())) > 1]
    apart = [i for i in often if i not in linked]
    if apart:
        groups = " and ".join(", ".join(map(str, group)) for group in (sorted(linked), apart))
        remarks.append(
            f"the markers {groups} of {robot} are never seen together; carry the body so that one "
            "image shows a marker of each group"
        )
    if len(linked) < 2:
        raise IpsysError(f"{robot}: its first marker {ids[0]} has no partner: {remarks[0]}")
    return [i for i in ids if i in linked], remarks


def _pairs(frames: Sequence[BodyFrame]) -> dict[tuple[int, int], list[int]]:
    """Return the numbers of the frames that show both markers of a pair."""
    pairs: dict[tuple[int, int], list[int]] = {}
    for number, frame in enumerate(frames):
        for pair in combinations(sorted(marker.id for marker in frame.markers), 2):
            pairs.setdefault(pair, []).append(number)
    return pairs


def spread_frames(frames: Sequence[BodyFrame]) -> list[BodyFrame]:
    """Return some frames: those seen by two cameras, those of each pair of markers, and others over the time.

    Each of the three parts is spread evenly over the time.
    """
    if len(frames) <= _MOST_FRAMES:
        return list(frames)
    part, pairs = _MOST_FRAMES // 3, _pairs(frames)
    linked = [n for n in range(len(frames) - 1) if links_cameras(frames[n], frames[n + 1])]
    kept = {n + after for n in _evenly(linked, part // 2) for after in (0, 1)}
    kept |= {n for rows in pairs.values() for n in _evenly(rows, part // len(pairs))}
    rest = [n for n in range(len(frames)) if n not in kept]
    return [frames[n] for n in sorted([*kept, *_evenly(rest, _MOST_FRAMES - len(kept))])]


def links_cameras(first: BodyFrame, second: BodyFrame) -> bool:
    """Return whether two cameras saw the body shortly after each other."""
    return first.camera != second.camera and 0 < second.time_ns - first.time_ns < LINKED_S * NS_PER_S


def _evenly(rows: Sequence[int], count: int) -> list[int]:
    return [rows[n] for n in np.linspace(0, len(rows) - 1, min(max(count, 1), len(rows))).astype(int)]
