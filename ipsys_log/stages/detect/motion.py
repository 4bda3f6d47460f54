"""Where a marker was in its last frames, and so where it will be."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.poses import rotation, rotation_vector
from ipsys_log.stages.detect.edges import Fit, Guess
from ipsys_log.units import NS_PER_S

__all__ = ["LONG_S", "Track", "extend", "predict", "same_speed"]

Array = NDArray[np.float64]

# After that nothing is left of a motion.
LONG_S = 0.5
# In sides per s.
_FASTEST = 100.0
_REMEMBERED = 3
# In sides per s and rad per s: less is not seen in the shear of a marker.
_SAME_SPEED = 0.1


class Sighting(NamedTuple):
    """A marker when its row was exposed, ``late_ns`` after the first row of its frame."""

    time_ns: int
    late_ns: int
    pose: Guess


# The newest sighting first.
Track = tuple[Sighting, ...]


def extend(track: Track, fit: Fit, frame_ns: int, row_time_s: float) -> Track:
    """A track, or an empty one, with what was just seen of the marker.

    Parameters
    ----------
    frame_ns : when the first row of the frame was exposed.
    row_time_s : between two rows.
    """
    late_ns = round(float(fit.corners_px[:, 1].mean()) * row_time_s * NS_PER_S)
    now = Sighting(frame_ns + late_ns, late_ns, fit.pose)
    # Time that does not go on leaves nothing to learn a speed from.
    ordered = not track or track[0].time_ns < now.time_ns
    return (now, *track[: _REMEMBERED - 1]) if ordered else (now,)


def predict(track: Track, frame_ns: int) -> Guess:
    """Where a marker is in a frame, if it lies in about the same row as before.

    It is on a parabola through three sightings, or on a line through two; but where it was, if that was long
    ago, or if it would have to be faster than any robot.
    """
    now = track[0]
    ahead_s = (frame_ns + now.late_ns - now.time_ns) / NS_PER_S
    if len(track) == 1 or not 0 <= ahead_s < LONG_S:
        return now.pose
    steps_s = [(one.time_ns - other.time_ns) / NS_PER_S for one, other in pairwise(track)]
    moved = [one.pose.centre - other.pose.centre for one, other in pairwise(track)]
    means = [step / step_s for step, step_s in zip(moved, steps_s, strict=True)]
    if np.abs(means).max() > _FASTEST:
        return now.pose
    # A mean velocity is that of the middle of its interval.
    gain = (means[0] - means[1]) / (sum(steps_s) / 2) if len(means) > 1 else np.zeros(3)
    velocity = means[0] + gain * steps_s[0] / 2
    turn_rad_s = rotation_vector(now.pose.rotation @ track[1].pose.rotation.T) / steps_s[0]
    turned = rotation(turn_rad_s * ahead_s) @ now.pose.rotation
    speed, turn = (velocity + gain * ahead_s) @ turned, turn_rad_s @ turned
    centre = now.pose.centre + (velocity + gain * ahead_s / 2) * ahead_s
    return Guess(now.pose.id, turned, centre, np.array([speed[0], speed[1], turn[2]]), now.pose.blurred)


def same_speed(one: Array | None, other: Array | None) -> bool:
    """Whether two motions, as in :class:`Guess`, are the same for what can be seen of them."""
    if one is None or other is None:
        return one is other
    return bool(np.abs(one - other).max() < _SAME_SPEED)
