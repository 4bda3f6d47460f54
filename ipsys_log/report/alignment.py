"""How the cameras of a log hang and what of the floor they see, and that in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.analysis.alignment import Alignment, align_camera, join_cameras
from ipsys_log.analysis.calibration_points import find_pairs, measured
from ipsys_log.analysis.coverage import Coverage, Hung, Overlap, cover_floor, find_overlaps
from ipsys_log.analysis.pairs import Measured
from ipsys_log.analysis.stationary import find_lying
from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import undistort
from ipsys_log.geometry.poses import invert_pose, make_pose
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CameraPoints, Measurement, Model, Pair, Rig
from ipsys_log.messages.channels import CAMERA_POINTS, MODEL
from ipsys_log.models.rigid import rigid_transform
from ipsys_log.runs.provenance import newest_run
from ipsys_log.runs.view import LogView
from ipsys_log.units import CM_PER_M

__all__ = ["AlignedLab", "read_alignment"]

Lenses = Mapping[str, CameraCalibration]

_LEAST_PLACES = 3
# A camera whose places say another tilt than the markers do was moved in between.
_MOVED_RAD = math.radians(1.0)
# Markers nearer together than this part of the picture say little of its edges.
_NARROW = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class AlignedLab:
    """How cameras hang, and what they see.

    Attributes
    ----------
    run : whose camera points these are.
    alignments : one for each camera, by name.
    lenses : by camera, where known.
    hung : the cameras whose places in the world are known; ``coverage`` None where that is not all it takes.
    overlaps : of neighbours, with a coverage or without one; ``diagonal_m`` what a marker needs.
    notes : what to know of it.
    """

    run: str
    rig: Rig
    alignments: tuple[Alignment, ...]
    lenses: Lenses
    hung: tuple[Hung, ...]
    coverage: Coverage | None
    overlaps: tuple[Overlap, ...]
    diagonal_m: float
    notes: tuple[str, ...]


def read_alignment(session: Session, run: str, rig: Rig, lenses: Lenses) -> AlignedLab:
    """Gather the markers that lie still in a log, and say how its cameras hang.

    Parameters
    ----------
    run : of the camera points, best those of ``--method pose``.
    rig, lenses : in force; the lenses by camera.
    """
    notes: list[str] = []
    measurements, pairs = _measured(session, run, rig, notes)
    frames: dict[str, list[CameraPoints]] = {camera: [] for camera in lenses}
    for message in session.messages(session.topics(CAMERA_POINTS, run)):
        frames.setdefault(str(message.camera), []).append(message.payload)
    alignments = tuple(
        align_camera(camera, find_lying(seen, measurements)) for camera, seen in sorted(frames.items())
    )
    notes += [note for one in alignments for note in _notes(one, lenses.get(one.camera))]
    if any(point.poses == () for seen in frames.values() for frame in seen for point in frame.points):
        notes.append(
            "these camera points are by eq. (3), which overstates a tilt by half: go two thirds of the way, "
            "or begin with frames"
        )
    hung = tuple(_hang(alignments, pairs, lenses, notes))
    length_m, height_m = _marker(rig)
    coverage = _cover(rig, hung, length_m, height_m, notes)
    if coverage is not None:
        overlaps = coverage.overlaps
    else:
        # Without a tape, or without a floor to end at.
        near = hung if len(hung) > 1 else join_cameras(alignments, lenses)
        overlaps = find_overlaps(near, height_m) if near else ()
    diagonal_m = length_m * math.sqrt(2)
    return AlignedLab(run, rig, alignments, lenses, hung, coverage, overlaps, diagonal_m, tuple(notes))


def _measured(
    session: Session, run: str, rig: Rig, notes: list[str]
) -> tuple[list[Measurement], Mapping[str, Sequence[Pair]]]:
    """What was measured, and what each camera saw of it; else what the newest model was fitted on."""
    places: list[Measured] = []
    try:
        view = LogView(session, {CAMERA_POINTS: run}, rig)
        places = measured(view)
        pairs = find_pairs(view, places)
    except IpsysError as error:
        # A slip of the tape must not keep anybody from hanging a camera; heights are by the ruler.
        notes.append(f"the measured places were left out: {error}")
        return [place.measurement for place in places], {}
    fitted = newest_run(session, MODEL)
    if not places and fitted is not None:
        model: Model = session.payloads(session.topics(MODEL, fitted))[-1]
        return [], {camera.camera: camera.pairs for camera in model.cameras}
    return [place.measurement for place in places], pairs


def _notes(alignment: Alignment, lens: CameraCalibration | None) -> Iterator[str]:
    name = f"camera {alignment.camera}"
    heights_m: dict[int, list[float]] = {}
    for lying, above_m in alignment.raised:
        heights_m.setdefault(lying.marker_id, []).append(above_m)
    for marker_id, all_m in heights_m.items():
        mean_cm = float(np.mean(all_m)) * CM_PER_M
        where = f"{abs(mean_cm):.0f} cm {'above' if mean_cm > 0 else 'below'} the plane of the others"
        yield f"{name}: marker {marker_id} lies {where}, and was left out; lay it on the floor"
    if alignment.uneven_m is not None:
        yield (
            f"{name}: its markers do not lie on one plane (off by {alignment.uneven_m * CM_PER_M:.0f} cm): "
            "one of them may lie on something; with five or more it can be told which"
        )
    if alignment.level and lens is not None and (part := _part_of_picture(alignment, lens)) < _NARROW:
        yield (
            f"{name}: its markers span only {part:.0%} of the picture; lay them out to its edges, or the "
            "spread looks smaller than it is"
        )


def _part_of_picture(alignment: Alignment, lens: CameraCalibration) -> float:
    """How much of the picture's width or height markers span, whichever is more."""
    middle, end = lens.K[:2, 2], np.array([lens.width - 1.0, lens.height - 1.0])
    edges = np.array([[0, middle[1]], [end[0], middle[1]], [middle[0], 0], [middle[0], end[1]]])
    (left, right, top, bottom) = undistort(edges, lens)
    uv = np.array([one.point_m[:2] / one.point_m[2] for one in alignment.lying])
    return float(np.nanmax(np.ptp(uv, axis=0) / np.array([right[0] - left[0], bottom[1] - top[1]])))


def _hang(
    alignments: Sequence[Alignment], pairs: Mapping[str, Sequence[Pair]], lenses: Lenses, notes: list[str]
) -> Iterator[Hung]:
    """The cameras whose place in the world follows from measured places."""
    for alignment in alignments:
        camera, found = alignment.camera, pairs.get(alignment.camera, ())
        if camera not in lenses:
            notes.append(f"camera {camera} has no calibration, so what it sees of the floor is not known")
            continue
        if len(found) < _LEAST_PLACES:
            if any(pairs.values()):
                notes.append(f"camera {camera} saw {len(found)} measured places: its coverage needs three")
            continue
        points_m, world_m = (
            np.array([getattr(pair, key) for pair in found]) for key in ("camera_m", "world_m")
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
                f"camera {camera} hangs otherwise than when its places were measured: what it sees of the "
                "floor is as it was then"
            )
        yield Hung(camera, lenses[camera], invert_pose(make_pose(axes, origin_m)))


def _marker(rig: Rig) -> tuple[float, float]:
    """Side and height of the markers that are hardest to see whole: the largest side, the greatest height."""
    markers = [marker.id for marker in rig.markers]
    lengths_m = [rig.length_of(marker) for marker in markers]
    heights_m = [rig.height_of(marker) or 0.0 for marker in markers]
    return max(lengths_m, default=rig.marker_length_m), max(heights_m, default=rig.marker_height_m or 0.0)


def _cover(
    rig: Rig, hung: Sequence[Hung], length_m: float, height_m: float, notes: list[str]
) -> Coverage | None:
    if not hung:
        notes.append(
            "what is seen of the whole floor needs at least three measured places in the view of each "
            "camera, not on a line: measure some (ipsys measure), and align that log (ipsys align LOG)"
        )
        return None
    if rig.floor is None:
        notes.append(
            "coverage needs the floor: write [floor] with width_m and depth_m into lab.toml, and give it "
            "with --rig"
        )
        return None
    return cover_floor(rig.floor, hung, length_m, height_m)
