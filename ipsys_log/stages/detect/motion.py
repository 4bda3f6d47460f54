"""Tracks of markers: the last poses of a marker, and the prediction of the next one."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ipsys_log.messages.arrays import Array
from ipsys_log.stages.detect.adjustment import Guess, MarkerFit
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotation, rotation_vector

# After this time, an earlier motion predicts nothing.
LONG_S = 0.5
# Largest speed of a robot, in sides of the marker per s.
_FASTEST = 100.0
_REMEMBERED = 3
# In sides per s and rad per s: a smaller difference is not visible in the shear of a marker.
_SAME_SPEED = 0.1


class MarkerSighting(NamedTuple):
    """A marker pose at the exposure of its row, ``late_ns`` after the first row of its frame."""

    time_ns: int
    late_ns: int
    pose: Guess


# The newest sighting first.
Track = tuple[MarkerSighting, ...]


def extend(track: Track, fit: MarkerFit, frame_ns: int, row_time_s: float) -> Track:
    """Return a track, possibly empty, with the new fit of its marker in front.

    Parameters
    ----------
    frame_ns : exposure time of the first row of the frame.
    row_time_s : time between the exposures of two rows.
    """
    late_ns = round(float(fit.corners_px[:, 1].mean()) * row_time_s * NS_PER_S)
    now = MarkerSighting(frame_ns + late_ns, late_ns, fit.pose)
    # Without an increase of time there is no speed.
    ordered = not track or track[0].time_ns < now.time_ns
    return (now, *track[: _REMEMBERED - 1]) if ordered else (now,)


def predict(track: Track, frame_ns: int) -> Guess:
    """Return the predicted pose of a marker in a frame, if the marker is in about the same row as before.

    The prediction is on a parabola through three sightings, or on a line through two. If the last sighting is
    old, or if the speed would be too high for a robot, the prediction is the last pose.
    """
    now = track[0]
    ahead_s = (frame_ns + now.late_ns - now.time_ns) / NS_PER_S
    if len(track) == 1 or not 0 <= ahead_s < LONG_S:
        return now.pose
    steps_s = [(newer.time_ns - older.time_ns) / NS_PER_S for newer, older in pairwise(track)]
    moved = [newer.pose.centre - older.pose.centre for newer, older in pairwise(track)]
    means = [step / step_s for step, step_s in zip(moved, steps_s, strict=True)]
    if np.abs(means).max() > _FASTEST:
        return now.pose
    # A mean velocity is valid for the middle of its interval.
    gain = (means[0] - means[1]) / (sum(steps_s) / 2) if len(means) > 1 else np.zeros(3)
    velocity = means[0] + gain * steps_s[0] / 2
    turn_rad_s = rotation_vector(now.pose.rotation @ track[1].pose.rotation.T) / steps_s[0]
    turned = rotation(turn_rad_s * ahead_s) @ now.pose.rotation
    speed, turn = (velocity + gain * ahead_s) @ turned, turn_rad_s @ turned
    centre = now.pose.centre + (velocity + gain * ahead_s / 2) * ahead_s
    return Guess(now.pose.id, turned, centre, np.array([speed[0], speed[1], turn[2]]), now.pose.blurred)


def same_speed(one: Array | None, other: Array | None) -> bool:
    """Return whether two motions, as in :class:`Guess`, are equal within the visible difference."""
    if one is None or other is None:
        return one is other
    return bool(np.abs(one - other).max() < _SAME_SPEED)
