"""A small made-up lab for tests of the joint calibration: cameras in a row above taped points."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.observations import (
    CalibrationPoint,
    CameraPrior,
    Observations,
    Sightings,
    marker_body,
)
from ipsys_log.messages import CameraCalibration
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import look_down, pose_facing_up, transform

Array = NDArray[np.float64]

REFERENCES_M = np.array([[1.2, 2.4], [3.7, 2.4]])
LENGTH_M = 0.2


class Truth(NamedTuple):
    lenses: list[CameraCalibration]
    camera_from_world: list[Array]
    places_m: Array


def make_lens(rng: np.random.Generator, name: str) -> CameraCalibration:
    K = np.array([[rng.uniform(1150, 1165), 0, 959.5], [0, rng.uniform(1150, 1165), 539.5], [0, 0, 1]])
    K[:2, 2] += rng.uniform(-40, 40, 2)
    D = np.array([-0.13, 0.01, -0.03, 0.02]) + rng.uniform(-1, 1, 4) * 0.005
    return CameraCalibration(0, name, 1920, 1080, "kannala_brandt", D, K)


def make_lab(
    seed: int,
    points: int = 16,
    cameras: int = 2,
    noise_px: float = 0.02,
    tape_sigma_m: float = 0.003,
    ruler_sigma_m: float = 0.001,
    tilt_deg: float = 2.0,
    lens_error: bool = True,
    places_m: Array | None = None,
) -> tuple[Observations, Truth]:
    """Return observations of stationary markers at random points or at ``places_m`` (n, 4), and the truth."""
    rng = np.random.default_rng([seed, 77])
    ys = 2.4 + 1.6 * (np.arange(cameras) - (cameras - 1) / 2)
    lenses, poses = [], []
    for number, y in enumerate(ys):
        towards, tilt = rng.uniform(0, 2 * np.pi), np.radians(tilt_deg) * rng.uniform(0.5, 1)
        tilt_rad = tilt * np.array([np.cos(towards), np.sin(towards), 0])
        lenses.append(make_lens(rng, f"c{number}"))
        poses.append(look_down(np.array([2.4, y, 2.1]) + rng.uniform(-0.03, 0.03, 3), tilt_rad))
    low, high = (0.5, max(ys[0] - 0.9, 0.4)), (4.3, min(ys[-1] + 0.9, 4.4))
    places = np.column_stack(
        [rng.uniform(low, high, (points, 2)), rng.choice([0.0, 0.1, 0.2], points), rng.uniform(-3, 3, points)]
    )
    places = places if places_m is None else places_m
    taped, rows = [], [[] for _ in lenses]  # type: list[CalibrationPoint], list[list[tuple[int, Array]]]
    for number, (x, y, z, heading) in enumerate(places):
        ranges = np.hypot(x - REFERENCES_M[:, 0], y - REFERENCES_M[:, 1])
        taped.append(
            CalibrationPoint(
                f"p{number}",
                0,
                REFERENCES_M,
                ranges + rng.normal(0, tape_sigma_m, 2),
                np.full(2, tape_sigma_m),
                start_m=np.array([x, y]) + rng.normal(0, tape_sigma_m, 2),
                height_m=z + rng.normal(0, ruler_sigma_m),
                height_sigma_m=max(ruler_sigma_m, 1e-7),
            )
        )
        corners_m = transform(pose_facing_up(x, y, z, heading), marker_corners(LENGTH_M))
        for lens, pose, own in zip(lenses, poses, rows, strict=True):
            points_c = transform(pose, corners_m)
            if np.hypot(points_c[:, 0], points_c[:, 1]).max() > 3 * points_c[:, 2].min():
                continue
            pixels = project(points_c, lens)
            if (pixels >= 5).all() and (pixels <= [1914, 1074]).all():
                own.append((number, pixels + rng.normal(0, noise_px, (4, 2))))
    sightings = []
    for own in rows:
        count = len(own)
        sightings.append(
            Sightings(
                np.zeros(count, dtype=np.intp),
                np.array([number for number, _ in own], dtype=np.intp),
                np.arange(count, dtype=np.float64),
                np.array([pixels for _, pixels in own]).reshape(-1, 4, 2),
                np.tile(noise_px**2 * np.eye(8), (count, 1, 1)),
            )
        )
    priors = []
    for lens in lenses:
        given = lens
        if lens_error:
            K = lens.K.copy()
            K[0, 0] *= 1 + rng.normal(0, 0.003)
            K[1, 1] *= 1 + rng.normal(0, 0.003)
            K[:2, 2] += rng.normal(0, 0.002 * 1920, 2)
            given = replace(lens, K=K, D=lens.D + rng.normal(0, 0.01, 4))
        priors.append(CameraPrior(lens.frame_id, given))
    bodies = (marker_body("0", LENGTH_M, 0.003),)
    observations = Observations(tuple(priors), bodies, tuple(taped), tuple(sightings))
    return observations, Truth(lenses, poses, places)
