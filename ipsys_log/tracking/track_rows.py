"""Rows of tracks in a log, from the poses of the filter or of the smoother."""

from __future__ import annotations

from math import pi, sqrt

from ipsys_log.messages import Track
from ipsys_log.tracking.tracks import Pose

# A heading that was never measured has a larger standard deviation.
_UNKNOWN_HEADING_RAD = 2.0


def make_track(pose: Pose) -> Track:
    """Return the row of a pose; its robot is a pair of the name and the marker id."""
    mean, covariance = pose.states.means[pose.state], pose.states.covariances[pose.state]
    robot, marker_id = pose.robot
    x_m, y_m, z_m, heading_rad, _, _, _, turn_rate, _, _ = mean.tolist()
    heading_sigma_rad, turn_sigma_rad_s = sqrt(covariance.item(3, 3)), sqrt(covariance.item(7, 7))
    has_heading = heading_sigma_rad < _UNKNOWN_HEADING_RAD
    return Track(
        robot,
        marker_id,
        x_m,
        y_m,
        z_m,
        (heading_rad + pi) % (2 * pi) - pi if has_heading else None,
        covariance[:3, :3] if pose.has_covariance else None,
        pose.cameras,
        pose.inside,
        mean[4:7],
        covariance[4:7, 4:7] if pose.has_covariance else None,
        heading_sigma_rad if has_heading and pose.has_covariance else None,
        turn_rate if has_heading else None,
        turn_sigma_rad_s if has_heading and pose.has_covariance else None,
        pose.coasting_ns,
        pose.age_ns,
    )
