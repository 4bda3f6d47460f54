"""Growth of the covariance of an unseen robot, from the errors of its predictions while it was seen."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

from ipsys_log.models.tracking.history import History
from ipsys_log.models.tracking.motion import MotionNoise, displacement
from ipsys_log.units import NS_PER_S

# A prediction of this duration is compared
_AHEAD_NS = 400_000_000
# every 0.1 s with the robot's position.
_EVERY_NS = 100_000_000
# Comparisons that the usual motion counts for.
_PRIOR = 15
# Comparisons after which the weight of an old one is 1 / e.
_MEMORY = 300
# Limits of the growth.
_LEAST = 0.1
_LARGEST = 10.0


@dataclass(slots=True)
class UnseenGrowth:
    """The growth of the covariance of one robot without sightings, in units of that by the usual motion.

    The state 0.4 s ago predicts the position of now. The squared error of the prediction, in units of the
    growth of its variance, is one comparison. The scale is the mean of all comparisons, old ones with less
    weight, and of the usual motion. The usual motion counts like about 3 s of driving.

    Attributes
    ----------
    weight, total : sum of the weights of the comparisons, and of their weighted squared errors.
    due_ns : earliest time of the next comparison.
    """

    weight: float = 0.0
    total: float = 0.0
    due_ns: int = 0

    @property
    def scale(self) -> float:
        """The scale of variances; it is between 0.1 and 10."""
        return min(max((_PRIOR + self.total) / (_PRIOR + self.weight), _LEAST), _LARGEST)

    def learn(self, history: History, noise: MotionNoise) -> None:
        """Compare the newest position of a history with its prediction, if the history is long enough.

        A comparison has the weight of the accelerations in the variance of the prediction: a new track, whose
        velocity is not known, tells nothing about them.

        Parameters
        ----------
        history : of the robot.
        noise : the usual motion.
        """
        newest = history.newest
        place = history.place_of(newest.time_ns - _AHEAD_NS)
        if not place:
            return
        before = history.records[place - 1]
        x_m, y_m, _, _, vx_m_s, vy_m_s, _, _, ax_m_s2, ay_m_s2 = before.states.means[before.state].tolist()
        now_x_m, now_y_m = newest.states.means[newest.state, :2].tolist()
        ahead_s = (newest.time_ns - before.time_ns) / NS_PER_S
        far_m, unit_m2 = displacement(ahead_s, noise.hold_s)
        missed_m = hypot(
            now_x_m - x_m - vx_m_s * ahead_s - ax_m_s2 * far_m,
            now_y_m - y_m - vy_m_s * ahead_s - ay_m_s2 * far_m,
        )
        # Both axes: the accelerations, and the errors of the velocity and of the acceleration.
        own_m2 = 2 * unit_m2 * (noise.acceleration_m_s2**2 + (noise.bend_rad_s * hypot(vx_m_s, vy_m_s)) ** 2)
        known = before.states.covariances[before.state].item
        growth_m2 = own_m2 + sum(
            ahead_s**2 * known(rate, rate)
            + 2 * ahead_s * far_m * known(rate, rate + 4)
            + far_m**2 * known(rate + 4, rate + 4)
            for rate in (4, 5)
        )
        kept, weight = 1 - 1 / _MEMORY, own_m2 / growth_m2
        self.weight = kept * self.weight + weight
        self.total = kept * self.total + weight * missed_m**2 / growth_m2
        self.due_ns = newest.time_ns + _EVERY_NS
