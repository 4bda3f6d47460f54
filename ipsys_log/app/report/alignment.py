"""The alignment of the cameras of a log, their coverage of the floor, and notes on both."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CameraPoints, Measurement, Model, Pair, Rig
from ipsys_log.messages.channels import CAMERA_POINTS, MODEL
from ipsys_log.models.plain_models import rigid_transform
from ipsys_log.statistics.alignment import Alignment, align_camera, join_cameras
from ipsys_log.statistics.calibration_points import find_pairs, measured
from ipsys_log.statistics.coverage import FloorCoverage, Overlap, cover_floor, find_overlaps
from ipsys_log.statistics.stationary import find_stationary
from ipsys_log.statistics.tape import RiggedMeasurement
from ipsys_log.units import CM_PER_M
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.poses import PosedCamera

Lenses = Mapping[str, CameraCalibration]

_LEAST_PLACES = 3
# Largest difference of the tilts from the calibration points and from the markers. Beyond it (plus three
# sigmas), the camera has moved between the two.
_MOVED_RAD = math.radians(1.0)
# Markers within a smaller part of the image give little information about its edges.
_NARROW = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class AlignedLab:
    """The alignment of the cameras of a lab, and their coverage.

    Attributes
    ----------
    run : run of the camera points.
    rig : rig in force.
    alignments : one alignment per camera, sorted by name.
    lenses : known intrinsics, by camera.
    mounted_cameras : cameras with a known pose in the world.
    coverage : coverage of the floor; None if the cameras or the floor are not known.
    overlaps : overlaps of neighbouring cameras, also without a coverage.
    diagonal_m : diagonal of a marker, the overlap that it needs.
    notes : remarks on the result.
    """

    run: str
    rig: Rig
    alignments: tuple[Alignment, ...]
    lenses: Lenses
    mounted_cameras: tuple[PosedCamera, ...]
    coverage: FloorCoverage | None
    overlaps: tuple[Overlap, ...]
    diagonal_m: float
    notes: tuple[str, ...]


def read_alignment(session: Session, run: str, rig: Rig, lenses: Lenses) -> AlignedLab:
    """Read the stationary markers of a log, and estimate the alignment of its cameras.

    Parameters
    ----------
    session : open logs.
    run : run of the camera points; a run of ``--method pose`` is best.
    rig, lenses : rig and intrinsics in force; ``lenses`` by camera.
    """
    notes: list[str] = []
    measurements, pairs = _measured(session, run, rig, notes)
    frames: dict[str, list[CameraPoints]] = {camera: [] for camera in lenses}
    for message in session.messages(session.topics(CAMERA_POINTS, run)):
        frames.setdefault(str(message.camera), []).append(message.payload)
    alignments = tuple(
        align_camera(camera, find_stationary(seen, measurements)) for camera, seen in sorted(frames.items())
    )
    notes += [note for alignment in alignments for note in _notes(alignment, lenses.get(alignment.camera))]
    if any(point.poses == () for seen in frames.values() for frame in seen for point in frame.points):
        notes.append(
            "these camera points are from eq. (3), which overestimates a tilt by half: turn the cameras by "
            "two thirds of the angle, or use a log with frames"
        )
    mounted = tuple(_mount(alignments, pairs, lenses, notes))
    length_m, height_m = _marker(rig)
    coverage = _cover(rig, mounted, length_m, height_m, notes)
    if coverage is not None:
        overlaps = coverage.overlaps
    else:
        # There are no tape measurements, or the rig has no floor.
        near = mounted if len(mounted) > 1 else join_cameras(alignments, lenses)
        overlaps = find_overlaps(near, height_m) if near else ()
    diagonal_m = length_m * math.sqrt(2)
    return AlignedLab(run, rig, alignments, lenses, mounted, coverage, overlaps, diagonal_m, tuple(notes))


def _measured(
    session: Session, run: str, rig: Rig, notes: list[str]
) -> tuple[list[Measurement], Mapping[str, Sequence[Pair]]]:
    """Return the measurements and their pairs by camera; without measurements, the newest model's pairs."""
    places: list[RiggedMeasurement] = []
    try:
        view = LogView(session, {CAMERA_POINTS: run}, rig)
        places = measured(view)
        pairs = find_pairs(view, places)
    except IpsysError as error:
        # An error of a tape measurement must not block the alignment. It needs only the heights, which are
        # measured with the ruler.
        notes.append(f"the calibration points were not used: {error}")
        return [place.measurement for place in places], {}
    fitted = newest_run(session, MODEL)
    if not places and fitted is not None:
        model: Model = session.payloads(session.topics(MODEL, fitted))[-1]
        return [], {camera.camera: camera.pairs for camera in model.cameras}
    return [place.measurement for place in places], pairs


def _notes(alignment: Alignment, lens: CameraCalibration | None) -> Iterator[str]:
    name = f"camera {alignment.camera}"
    heights_m: dict[int, list[float]] = {}
    for marker, above_m in alignment.raised_markers:
        heights_m.setdefault(marker.marker_id, []).append(above_m)
    for marker_id, all_m in heights_m.items():
        mean_cm = float(np.mean(all_m)) * CM_PER_M
        position = (
            f"{abs(mean_cm):.0f} cm {'above' if mean_cm > 0 else 'below'} the plane of the other markers"
        )
        yield f"{name}: marker {marker_id} is {position} and was not used; put it on the floor"
    if alignment.uneven_m is not None:
        yield (
            f"{name}: its markers are not on one plane (error {alignment.uneven_m * CM_PER_M:.0f} cm): "
            "one of them may be above the floor; use five or more markers to find it"
        )
    if alignment.level and lens is not None and (part := _part_of_picture(alignment, lens)) < _NARROW:
        yield (
            f"{name}: its markers span only {part:.0%} of the image; put markers near the "
            "image edges, or the spread is underestimated"
        )


def _part_of_picture(alignment: Alignment, lens: CameraCalibration) -> float:
    """Return the part of the image that the markers span: of its width or its height, the larger part."""
    middle, end = lens.K[:2, 2], np.array([lens.width - 1.0, lens.height - 1.0])
    edges = np.array([[0, middle[1]], [end[0], middle[1]], [middle[0], 0], [middle[0], end[1]]])
    (left, right, top, bottom) = undistort(edges, lens)
    uv = np.array([marker.point_m[:2] / marker.point_m[2] for marker in alignment.floor_markers])
    return float(np.nanmax(np.ptp(uv, axis=0) / np.array([right[0] - left[0], bottom[1] - top[1]])))


def _mount(
    alignments: Sequence[Alignment], pairs: Mapping[str, Sequence[Pair]], lenses: Lenses, notes: list[str]
) -> Iterator[PosedCamera]:
    """Yield the cameras with a pose in the world that follows from calibration points."""
    for alignment in alignments:
        camera, camera_pairs = alignment.camera, pairs.get(alignment.camera, ())
        if camera not in lenses:
            notes.append(f"camera {camera} has no calibration, so its coverage is not known")
            continue
        if len(camera_pairs) < _LEAST_PLACES:
            if any(pairs.values()):
                notes.append(
                    f"camera {camera} saw {len(camera_pairs)} calibration points: its coverage needs three"
                )
            continue
        points_m, world_m = (
            np.array([getattr(pair, key) for pair in camera_pairs]) for key in ("camera_m", "world_m")
        )
        try:
            axes, origin_m = rigid_transform(points_m, world_m)
        except IpsysError as error:
            notes.append(f"camera {camera}, coverage: {error}")
            continue
        cosine = 1.0 if alignment.down is None else float(-axes[2] @ alignment.down)
        if alignment.axes == 2 and math.acos(min(1.0, cosine)) > _MOVED_RAD + 3 * (
            alignment.sigma_rad or 0.0
        ):
            notes.append(
                f"camera {camera} has moved since its calibration points were measured: "
                "its coverage is for the old pose"
            )
        yield PosedCamera(camera, lenses[camera], axes.T, origin_m)


def _marker(rig: Rig) -> tuple[float, float]:
    """Return the largest side and the greatest height of the markers; such markers need the most overlap."""
    markers = [marker.id for marker in rig.markers]
    lengths_m = [rig.length_of(marker) for marker in markers]
    heights_m = [rig.height_of(marker) or 0.0 for marker in markers]
    return max(lengths_m, default=rig.marker_length_m), max(heights_m, default=rig.marker_height_m or 0.0)


def _cover(
    rig: Rig, mounted: Sequence[PosedCamera], length_m: float, height_m: float, notes: list[str]
) -> FloorCoverage | None:
    if not mounted:
        notes.append(
            "the coverage of the floor needs at least three calibration points in the view of each camera, "
            "not on a line: measure some (ipsys measure), and align that log (ipsys align LOG)"
        )
        return None
    if rig.floor is None:
        notes.append(
            "the coverage needs the size of the floor: write [floor] with width_m and "
            "depth_m into lab.toml, and give it with --rig"
        )
        return None
    return cover_floor(rig.floor, mounted, length_m, height_m)
