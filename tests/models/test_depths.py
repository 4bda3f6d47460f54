"""The check of known marker heights by the depths of eq. (3)."""

from __future__ import annotations

import numpy as np
import pytest

from ipsys_log.messages import CameraPoint, CameraPoints, Message, Model, Rig, RigMarker
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.statistics.camera_models import fit_model
from tests import labs

HEIGHT_M = 0.1


def drive(rng: np.random.Generator, height_m: float) -> np.ndarray:
    return np.column_stack([rng.uniform(0.6, 4.2, 200), rng.uniform(0.4, 1.4, 200), np.full(200, height_m)])


def located(model: Model, points_m: np.ndarray, rig: Rig) -> list[bool]:
    """Return ``inside`` of the position of each camera point, of a marker at the height in the rig."""
    locate = LocatePoints(model)
    list(locate(Message("/rig", 0, 0, rig)))
    inside: list[bool] = []
    for point_m in points_m:
        seen = CameraPoints(0, (CameraPoint(0, *point_m.tolist()),))
        (positions,) = locate(Message("/runs/lab/cameras/red/camera_points", 0, 0, seen, "red"))
        inside += [bool(position.inside) for position in positions.positions]
    return inside


@pytest.mark.parametrize("heights", [labs.HEIGHTS, (0.1,)])
def test_position_of_a_marker_at_another_height_is_not_inside(heights: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    camera, world = labs.camera(rng), labs.places(rng, 40, heights=heights)
    tape, covariances = labs.measure(world, rng)
    model = fit_model("rayplane", {"red": labs.pairs(camera.see(world, rng), tape, covariances)}, 0)
    rig = Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(0),), marker_height_m=HEIGHT_M)
    shares = {
        height_m: np.mean(located(model, camera.see(drive(rng, height_m), rng), rig))
        for height_m in (0.0, 0.05, HEIGHT_M, 0.15, 0.2)
    }
    assert shares[HEIGHT_M] > 0.9, shares
    assert max(share for height_m, share in shares.items() if height_m != HEIGHT_M) < 0.01, shares


def test_covariance_contains_the_sigma_of_the_height_in_the_rig() -> None:
    rng = np.random.default_rng(0)
    camera, world = labs.camera(rng), labs.places(rng, 40)
    tape, covariances = labs.measure(world, rng)
    model = fit_model("rayplane", {"red": labs.pairs(camera.see(world, rng), tape, covariances)}, 0)
    point_m = camera.see(np.array([[4.2, 0.9, HEIGHT_M]]), rng)[0]
    sigmas_m = {}
    for sigma_m in (None, 0.01):
        locate = LocatePoints(model)
        rig = Rig("lab", "DICT_4X4_100", 0.2, marker_height_m=HEIGHT_M, marker_height_sigma_m=sigma_m)
        list(locate(Message("/rig", 0, 0, rig)))
        seen = CameraPoints(0, (CameraPoint(0, *point_m.tolist()),))
        (positions,) = locate(Message("t", 0, 0, seen, "red"))
        covariance_m2 = positions.positions[0].covariance_m2
        assert covariance_m2 is not None
        sigmas_m[sigma_m] = np.sqrt(covariance_m2[0, 0])
    # The marker is 1.8 m beside the camera, which is 2 m above it.
    assert sigmas_m[None] < 0.003
    assert sigmas_m[0.01] == pytest.approx(0.009, rel=0.15)
