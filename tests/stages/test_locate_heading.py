"""Headings of level markers under a tilted camera."""

from __future__ import annotations

import numpy as np
import pytest

from ipsys_log.messages import CameraPoint, CameraPoints, Message, Pair, Rig
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.vision.poses import look_down, transform

RIG = Message("/rig", 0, 0, Rig("lab", "DICT_4X4_100", 0.2, marker_height_m=0.1))


@pytest.mark.parametrize(
    ("model", "most_deg"), [("rigid", 0.001), ("rayplane", 0.001), ("best", 0.1), ("poly", 0.5)]
)
def test_heading_under_a_tilted_camera_is_that_of_a_level_marker(model: str, most_deg: float) -> None:
    """The camera is tilted by 25 degrees: a step at constant depth rises by 4 mm on 1 cm."""
    rng = np.random.default_rng(0)
    camera_from_world = look_down(np.array([2.0, 2.0, 2.1]), np.radians([25.0, 0.0, 0.0]))
    world_m = np.column_stack([rng.uniform(1.0, 3.0, (60, 2)), rng.uniform(0.0, 0.2, 60)])
    camera_m = transform(camera_from_world, world_m)
    pairs = [
        Pair(str(n), 0, seen, place, 1) for n, (seen, place) in enumerate(zip(camera_m, world_m, strict=True))
    ]
    locate = LocatePoints(fit_model(model, {"red": pairs}, 0))
    list(locate(RIG))
    places_m = np.column_stack([rng.uniform(1.3, 2.7, (40, 2)), np.full(40, 0.1)])
    headings = rng.uniform(-np.pi, np.pi, 40)
    steps_m = 1e-4 * np.column_stack([np.cos(headings), np.sin(headings), np.zeros(40)])
    near, ahead = (transform(camera_from_world, points_m) for points_m in (places_m, places_m + steps_m))
    du, dv = (ahead[:, :2] / ahead[:, 2:] - near[:, :2] / near[:, 2:]).T
    seen = [
        CameraPoint(n, x_m, y_m, z_m, angle)
        for n, ((x_m, y_m, z_m), angle) in enumerate(
            zip(near.tolist(), (-np.arctan2(dv, du)).tolist(), strict=True)
        )
    ]
    (made,) = locate(Message("t", 1, 1, CameraPoints(1, tuple(seen)), "red"))
    found = np.array([position.heading_rad for position in made.positions])
    errors_deg = np.degrees(np.abs((found - headings + np.pi) % (2 * np.pi) - np.pi))
    assert errors_deg.max() < most_deg
