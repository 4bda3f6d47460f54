"""Simulated labs with known ground truth, by geometry alone: camera points and tape distances."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.messages import (
    IMPORTED,
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    CameraPoint,
    CameraPoints,
    Distance,
    Floor,
    Interval,
    Measurement,
    Message,
    Pair,
    ReferencePoint,
    Rig,
    RigCamera,
    RigMarker,
    Run,
    WorldPoint,
)
from ipsys_log.units import NS_PER_S

Array = NDArray[np.float64]

A, B = np.array([1.2192, 2.4384]), np.array([3.6576, 2.4384])
HEIGHTS = (0.0, 0.05, 0.1, 0.15, 0.2)


@dataclass(frozen=True)
class Camera:
    """A camera at ``origin_m`` that looks down, with small errors of intrinsics and depths.

    ``along`` and ``across`` are the noise of a depth (relative) and of (u, v), at the principal point.
    """

    origin_m: Array
    rotation: Array
    lens: tuple[float, float, float] = (-0.004, 0.001, -0.001)
    along: float = 0.0004
    across: float = 0.0001

    def see(self, world_m: Array, rng: np.random.Generator) -> Array:
        """Return camera points (n, 3) of world points (n, 3), with noise."""
        inside = (world_m - self.origin_m) @ self.rotation
        u, v = inside[:, 0] / inside[:, 2], inside[:, 1] / inside[:, 2]
        growth = 1 + u * u + v * v
        for _ in range(20):  # the lens model maps distorted to true points: solve for the distorted point
            shift = self._shift(u, v)
            u, v = inside[:, 0] / inside[:, 2] - shift[0], inside[:, 1] / inside[:, 2] - shift[1]
        u = u + rng.normal(0, self.across, len(u)) * growth
        v = v + rng.normal(0, self.across, len(v)) * growth
        off = 0.004 * (growth - 1) - 0.003 * u + self.along * growth * rng.normal(size=len(u))
        z = inside[:, 2] / (1 + off)
        return np.stack([u * z, v * z, z], axis=1)

    def _shift(self, u: Array, v: Array) -> tuple[Array, Array]:
        k1, p1, p2 = self.lens
        r2 = u * u + v * v
        return (
            k1 * u * r2 + p1 * 2 * u * v + p2 * (r2 + 2 * u * u),
            k1 * v * r2 + p1 * (r2 + 2 * v * v) + p2 * 2 * u * v,
        )


def camera(
    rng: np.random.Generator, y_m: float = 0.9, along: float = 0.0004, across: float = 0.0001
) -> Camera:
    """Return one of the cameras above the paper's floor, with a small random tilt."""
    turn = (np.pi + rng.normal(0, 0.02), rng.normal(0, 0.02), rng.normal(0, 0.05))
    return Camera(
        np.array([2.4, y_m, 2.1]), Rotation.from_euler("xyz", turn).as_matrix(), along=along, across=across
    )


def places(
    rng: np.random.Generator, count: int, y_m: float = 0.9, heights: tuple[float, ...] = HEIGHTS
) -> Array:
    """Return world points (n, 3) in a camera's view, at tape crossings above 15 degrees."""
    found: list[Array] = []
    while len(found) < count:
        point = np.array([rng.uniform(0.1, 4.7), rng.uniform(y_m - 0.8, y_m + 0.8), rng.choice(heights)])
        a, b = (point[:2] - end for end in (A, B))
        if abs(a[0] * b[1] - a[1] * b[0]) > np.sin(np.radians(15)) * np.linalg.norm(a) * np.linalg.norm(b):
            found.append(point)
    return np.array(found)


def tape_covariances(world_m: Array, sigma_m: float = 0.003, ruler_m: float = 0.001) -> Array:
    """Return the covariances of the world points (n, 3, 3), to first order in the errors of the tape."""
    covariances = np.zeros((len(world_m), 3, 3))
    for n, point in enumerate(world_m):
        units = np.array([(point[:2] - end) / np.linalg.norm(point[:2] - end) for end in (A, B)])
        inverse = np.linalg.inv(units)
        covariances[n, :2, :2] = sigma_m**2 * inverse @ inverse.T
        covariances[n, 2, 2] = ruler_m**2
    return covariances


def measure(world_m: Array, rng: np.random.Generator, sigma_m: float = 0.003) -> tuple[Array, Array]:
    """Return measured world points, (n, 3), and their covariances (n, 3, 3)."""
    covariances = tape_covariances(world_m, sigma_m)
    roots = np.linalg.cholesky(covariances)
    return world_m + np.einsum("nij,nj->ni", roots, rng.normal(size=world_m.shape)), covariances


def pairs(points_m: Array, world_m: Array, covariances: Array, name: str = "m") -> list[Pair]:
    return [
        Pair(f"{name}{n:02d}", 0, point, world, 1, covariance)
        for n, (point, world, covariance) in enumerate(zip(points_m, world_m, covariances, strict=True))
    ]


def session(
    points_m: Mapping[str, Array],
    world_m: Array,
    rig: Rig,
    distances: bool = False,
    labels: Callable[[int], tuple[str, ...]] = lambda n: (),
) -> Iterator[Message]:
    """Write a log of calibration points at one point per second.

    The log has the camera points of each camera (NaN if not seen). With ``distances``, a point has tape
    distances to A and B, otherwise a world point.
    """
    start_ns = 1_700_000_000 * NS_PER_S
    yield Message(RIG_TOPIC, start_ns, start_ns, rig)
    for n, world in enumerate(world_m):
        time_ns = start_ns + (n + 1) * NS_PER_S
        for camera, points in points_m.items():
            if np.isfinite(points[n]).all():
                seen = CameraPoints(time_ns, (CameraPoint(0, *points[n].tolist()),))
                topic = f"/runs/lab/cameras/{camera}/camera_points"
                yield Message(topic, time_ns, time_ns, seen, camera)
        to_ends = tuple(
            Distance(name, float(np.hypot(*(world[:2] - end))), 0.003) for name, end in (("A", A), ("B", B))
        )
        measurement = Measurement(
            time_ns,
            f"m{n:02d}",
            marker_id=0,
            distances=to_ends if distances else (),
            side=("left" if world[1] > A[1] else "right") if distances else None,
            height_m=float(world[2]),
            still=Interval(time_ns, time_ns),
            point=None if distances else WorldPoint(*world.tolist()),
            splits=labels(n),
        )
        yield Message(MEASUREMENTS_TOPIC, time_ns + 1, time_ns, measurement)
    yield Message("/runs/lab/record", time_ns + 2, time_ns, Run(time_ns, "lab", IMPORTED))


RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    (RigMarker(0, robot="ada"),),
    (RigCamera("red"),),
    (ReferencePoint("A", *A.tolist()), ReferencePoint("B", *B.tolist())),
    Floor(4.8768, 4.8768),
)
