"""Simulated calibration points: poses of the markers, and readings of tape and ruler."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import Camera, sees
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Distance, Interval, Measurement, ReferencePoint
from ipsys_log.vision.markers import PlacedMarker, black_cells, print_outline
from ipsys_log.vision.poses import make_pose, pose_facing_up, rotation

REFERENCES = (ReferencePoint("A", 1.2192, 2.4384), ReferencePoint("B", 3.6576, 2.4384))
_DRAWS = 4000
# Number of candidates of a pose. The selected candidate is the one farthest from all earlier poses.
_CANDIDATES = 4
_TEST_SHARE = 0.2


def reference_points(settings: LabSettings) -> tuple[ReferencePoint, ReferencePoint]:
    """Return the two points from which the tape measures; in a hall, half of its length apart."""
    if settings.grid is None:
        return REFERENCES
    x_m, y_m = settings.floor_m
    return ReferencePoint("A", x_m / 4, y_m / 2), ReferencePoint("B", 3 * x_m / 4, y_m / 2)


@dataclass(frozen=True, slots=True)
class SimulatedPose:
    """The pose of a marker that faces up: its centre in world m, and its heading in rad."""

    marker_id: int
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class SimulatedPoint:
    """A calibration point; ``camera`` is the camera for which it is chosen."""

    pose: SimulatedPose
    camera: str


def place_marker(where: SimulatedPose, settings: LabSettings) -> PlacedMarker:
    """Return the print of a marker at a pose."""
    world_from_marker = pose_facing_up(where.x_m, where.y_m, where.z_m, where.heading_rad)
    if settings.top_tilt_deg:
        world_from_marker = world_from_marker @ _marker_from_top(where.marker_id, settings)
    return PlacedMarker(where.marker_id, settings.marker_length_m, world_from_marker)


def _marker_from_top(marker_id: int, settings: LabSettings) -> Array:
    """Return the constant tilt of a marker on its robot, (4, 4), about a horizontal axis."""
    rng = random_stream(settings.seed, Purpose.TOPS, marker_id)
    tilt_rad, axis_rad = np.radians(rng.uniform(0.0, settings.top_tilt_deg)), rng.uniform(-np.pi, np.pi)
    axis = np.array([np.cos(axis_rad), np.sin(axis_rad), 0.0])
    return make_pose(rotation(tilt_rad * axis), np.zeros(3))


def cameras_seeing(where: SimulatedPose, cameras: Sequence[Camera], settings: LabSettings) -> tuple[str, ...]:
    """Return the names of the cameras whose image contains the whole print, white margin included."""
    outline_m = print_outline(place_marker(where, settings), settings.dictionary)
    return tuple(camera.name for camera in cameras if sees(camera, outline_m).all())


def overlap(
    first: Array, second: Array, cameras: Sequence[Camera], settings: LabSettings
) -> NDArray[np.bool_]:
    """Return a mask (...) of the pairs of prints, (..., 3) in m, that might overlap in any image.

    The projection of the disc around a print, from the camera onto the floor, is its shadow. If two shadows
    do not overlap, the prints do not overlap in the image.
    """
    cells = len(black_cells(settings.dictionary, 0))
    radius_m = settings.marker_length_m * cells / (cells - 2) / np.sqrt(2)
    met = np.zeros(np.broadcast_shapes(first.shape, second.shape)[:-1], dtype=bool)
    for camera in cameras:
        eye_m = camera.origin_m
        growth = [eye_m[2] / (eye_m[2] - point[..., 2:]) for point in (first, second)]
        shadows = [
            eye_m[:2] + g * (p[..., :2] - eye_m[:2]) for g, p in zip(growth, (first, second), strict=True)
        ]
        apart_m = np.linalg.norm(shadows[0] - shadows[1], axis=-1)
        met |= apart_m < 1.05 * radius_m * (growth[0] + growth[1])[..., 0]
    return met


def plan_points(settings: LabSettings, cameras: Sequence[Camera]) -> list[tuple[SimulatedPoint, ...]]:
    """Return sets of calibration points, one for each marker, until every camera sees enough of them.

    The required number for each camera is about ``settings.points``.
    """
    rng = random_stream(settings.seed, Purpose.PLACES)
    seen: dict[str, list[SimulatedPose]] = {camera.name: [] for camera in cameras}
    sets: list[tuple[SimulatedPoint, ...]] = []
    while min(map(len, seen.values())) < settings.stations:
        points: list[SimulatedPoint] = []
        for marker_id in range(settings.markers):
            camera = min(cameras, key=lambda one: len(seen[one.name]))
            taken = [point.pose for point in points]
            pose = choose_place(rng, settings, cameras, camera, marker_id, taken, seen[camera.name])
            points.append(SimulatedPoint(pose, camera.name))
            for name in cameras_seeing(pose, cameras, settings):
                seen[name].append(pose)
        sets.append(tuple(points))
    return sets


def split(sets: Sequence[tuple[SimulatedPoint, ...]], seed: int) -> list[tuple[str, ...]]:
    """Return the split of each calibration point, in order: a fifth of each camera's points is held out."""
    rng = random_stream(seed, Purpose.SPLIT)
    cameras = [point.camera for points in sets for point in points]
    splits: list[tuple[str, ...]] = [("train",)] * len(cameras)
    for camera in dict.fromkeys(cameras):
        own = [index for index, name in enumerate(cameras) if name == camera]
        for index in rng.permutation(own)[: round(_TEST_SHARE * len(own))]:
            splits[index] = ("test",)
    return splits


def measure(
    where: SimulatedPose, settings: LabSettings, index: int, times_ns: Sequence[int], splits: tuple[str, ...]
) -> Measurement:
    """Simulate the manual measurement of a marker: distances from A and B on the floor, and its height.

    Parameters
    ----------
    where : the ground truth.
    settings : the sigmas of tape and ruler.
    index : number of the measurement; every second measurement contains its stationary interval.
    times_ns : times of the frames in which the marker is stationary at this pose.
    splits : splits of the calibration point, such as train or test.
    """
    rng = random_stream(settings.seed, Purpose.TAPE, index)
    references = reference_points(settings)
    distances = _tape(where, references, settings.tape_sigma_m, rng)
    readout_ns = (settings.height - 1) * settings.row_time_ns
    # A marker on the floor needs no ruler.
    height_m = where.z_m + (rng.normal(0.0, settings.ruler_sigma_m) if where.z_m else 0.0)
    return Measurement(
        timestamp=times_ns[len(times_ns) // 2],
        id=f"s{index:03d}",
        marker_id=where.marker_id,
        distances=tuple(
            Distance(reference.name, float(distance_m), settings.tape_sigma_m)
            for reference, distance_m in zip(references, distances, strict=True)
        ),
        side="left" if where.y_m >= references[0].y_m else "right",
        height_m=float(height_m),
        height_sigma_m=settings.ruler_sigma_m,
        still=Interval(times_ns[0], times_ns[-1] + readout_ns) if index % 2 == 0 else None,
        splits=splits,
    )


def tape_lengths_m(where: SimulatedPose, references: Sequence[ReferencePoint] = REFERENCES) -> Array:
    """Return the true distances of a marker from A and B in the plane of the floor, (2,) in m."""
    return np.array([np.hypot(where.x_m - p.x_m, where.y_m - p.y_m) for p in references])


def _tape(
    where: SimulatedPose,
    references: tuple[ReferencePoint, ReferencePoint],
    sigma_m: float,
    rng: np.random.Generator,
) -> Array:
    """Draw two distances that form a triangle with AB; repeat invalid readings."""
    a, b = references
    true_m = tape_lengths_m(where, references)
    base_m = np.hypot(b.x_m - a.x_m, b.y_m - a.y_m)
    for _ in range(1000):
        read_m = true_m + rng.normal(0.0, sigma_m, 2)
        if (read_m > 0).all() and abs(read_m[0] - read_m[1]) < base_m < read_m.sum():
            return read_m
    raise IpsysError(
        f"simulator: tape_sigma_m = {sigma_m:g} m is too large for a point at "
        f"({where.x_m:.2f}, {where.y_m:.2f}) m; set a smaller tape_sigma_m or a larger tape_angle_deg"
    )


def choose_place(
    rng: np.random.Generator,
    settings: LabSettings,
    cameras: Sequence[Camera],
    camera: Camera,
    marker_id: int,
    taken: Sequence[SimulatedPose],
    before: Sequence[SimulatedPose],
    suits: Callable[[SimulatedPose, Camera, LabSettings], bool] = lambda where, camera, settings: True,
) -> SimulatedPose:
    """Choose a pose in a camera's field of view, far from poses ``before``, not overlapping ``taken``."""
    candidates: list[SimulatedPose] = []
    for _ in range(_DRAWS):
        x_m, y_m = rng.uniform(0, settings.floor_m, 2)
        z_m, heading_rad = rng.choice(settings.heights_m), rng.uniform(-np.pi, np.pi)
        candidate = SimulatedPose(marker_id, float(x_m), float(y_m), float(z_m), float(heading_rad))
        if _fits(candidate, settings, cameras, camera, taken) and suits(candidate, camera, settings):
            candidates.append(candidate)
        if len(candidates) == _CANDIDATES:
            break
    if not candidates:
        raise IpsysError(
            f"simulator: marker {marker_id} has no room beside {len(taken)} others in the view of "
            f"{camera.name!r}; set fewer or smaller markers"
        )
    return max(candidates, key=lambda where: _distance(where, before))


def _fits(
    where: SimulatedPose,
    settings: LabSettings,
    cameras: Sequence[Camera],
    camera: Camera,
    taken: Sequence[SimulatedPose],
) -> bool:
    if (
        not sees(camera, _centre(where)[None])[0]
        or _tape_angle_deg(where, settings) < settings.tape_angle_deg
    ):
        return False
    if camera.name not in cameras_seeing(where, (camera,), settings):
        return False
    others = np.array([_centre(other) for other in taken]).reshape(-1, 3)
    return not overlap(_centre(where), others, cameras, settings).any()


def _tape_angle_deg(where: SimulatedPose, settings: LabSettings) -> float:
    """Return the crossing angle of the lines from A and B, 0..90 degrees: flat triangles are inaccurate."""
    references = reference_points(settings)
    to_a, to_b = (np.array([where.x_m - p.x_m, where.y_m - p.y_m]) for p in references)
    cross = abs(to_a[0] * to_b[1] - to_a[1] * to_b[0])
    return float(np.degrees(np.arcsin(min(cross / (np.hypot(*to_a) * np.hypot(*to_b)), 1.0))))


def _centre(where: SimulatedPose) -> Array:
    return np.array([where.x_m, where.y_m, where.z_m])


def _distance(where: SimulatedPose, before: Sequence[SimulatedPose]) -> float:
    return min((np.hypot(where.x_m - p.x_m, where.y_m - p.y_m) for p in before), default=np.inf)
