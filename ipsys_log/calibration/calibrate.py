"""Intrinsic calibration of one camera, or of several cameras separately."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import Sighting
from ipsys_log.calibration.board_search import Looked, NotSeenError, check_sizes, look
from ipsys_log.calibration.bundle_adjustment import Corners, Fit, camera_points
from ipsys_log.calibration.image_selection import Coverage, Dropped, advice, choose, measure_coverage
from ipsys_log.calibration.images import Pictures
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.solve import Solved, find_start, rms_px, solve, tells_focal_length
from ipsys_log.calibration.two_cameras import (
    MOST_RMS_PX,
    find_better_model,
    find_two_cameras,
    two_cameras_fault,
)
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration

__all__ = ["LEAST_PICTURES", "Calibrated", "Failure", "calibrate", "calibrate_cameras"]

Array = NDArray[np.float64]

LEAST_PICTURES = 5
# Fewer images are refused even with --force.
_LEAST_INSISTED = 3
# A note is written for a focal length with a larger relative standard deviation, and for coefficients with a
# larger standard deviation. Such coefficients are useless.
_UNSURE = 0.02
_UNTOLD = 1.0
# RMS errors: above the first, other lens models are tried; the right lens model and a flat board leave less
# than the second.
_TRY_OTHERS_PX, _OFF_PX = 0.4, 1.0
# A focal length with a larger relative standard deviation is not a result.
_UNKNOWN = 0.1
# A note is written if more than this share of the images shows another grid.
_MANY_OTHERS = 0.2
# If the edges in all images are wider than this, the scene is too dark or the camera is out of focus.
_SOFT_PX = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """The intrinsics of a camera and their quality.

    Attributes
    ----------
    camera, lens : name of the camera, and its intrinsics.
    names, values, sigmas : of the parameters; the standard deviations are 0 if not fitted.
    square : whether fx = fy was assumed.
    rms_px, median_px : of the reprojection errors: the root of the mean of dx^2 + dy^2, over all corners of
        all used images.
    looked, seen : numbers of examined images, and of images that show the board.
    used : names and RMS in px of the images in the fit.
    dropped : bad images with the board that were left out, and the reasons.
    spare : good images that add no information.
    unseen : images without the board, and their contents.
    far_corners : number of single outlier corners that were left out of used images.
    coverage, notes : positions of the board, and advice.
    pixels, residuals_px : (n, 2), of all used corners.
    """

    camera: str
    lens: CameraCalibration
    names: tuple[str, ...]
    values: Array
    sigmas: Array
    square: bool
    rms_px: float
    median_px: float
    looked: int
    seen: int
    used: tuple[tuple[str, float], ...]
    dropped: tuple[Dropped, ...]
    spare: tuple[Dropped, ...]
    unseen: tuple[Dropped, ...]
    far_corners: int
    coverage: Coverage
    notes: tuple[str, ...]
    pixels: Array
    residuals_px: Array


def calibrate(
    camera: str, looked: Looked, board: Board, model: LensModel, insist: bool = False
) -> Calibrated:
    """Estimate the intrinsics of a camera from its images.

    Parameters
    ----------
    camera, looked, board, model : name of the camera, sightings, board, and lens model.
    insist : return a result that is too poor to use, with a note that gives the reason.

    Raises
    ------
    IpsysError
        Too few images are usable, the images are of two cameras, or the reprojection error is large; the
        text says what to do.
    """
    chosen = choose(looked.sightings, board, looked.size_px)
    used = chosen.used
    bad = [*looked.unreadable, *chosen.bad]
    faults = [_few_pictures(camera, used, bad, looked, insist)]
    corners = Corners(
        np.concatenate([board.points_m(s.ids) for s in used]),
        np.concatenate([s.pixels for s in used]),
        np.repeat(np.arange(len(used)), [len(s.ids) for s in used]),
        len(used),
    )
    start = _start(camera, model, corners, looked.size_px)
    faults.append(_two_cameras(model, start, corners, used, looked.size_px))
    _refuse(camera, faults, insist)
    solved = _solved(camera, model, corners, looked.size_px, start)
    bad += [Dropped(used[excluded.picture].name, excluded.reason) for excluded in solved.left]
    fitted = [used[n] for n in solved.pictures]
    faults.append(_far_off(model, solved, corners, looked.size_px))
    _refuse(camera, faults, insist)
    faults.append(_few_pictures(camera, fitted, bad, looked, insist))
    notes = tuple(f"written only for --force: {fault}" for fault in faults if fault)
    return _judged(camera, model, looked, fitted, solved, bad, chosen.spare, notes)


def _refuse(camera: str, faults: list[str], insist: bool) -> None:
    for fault in faults:
        if fault and not insist:
            raise IpsysError(f"camera {camera}: {fault}; or give --force")


def _start(camera: str, model: LensModel, corners: Corners, size_px: tuple[int, int]) -> Fit:
    try:
        return find_start(model, corners, size_px)
    except np.linalg.LinAlgError as error:
        raise _alike(camera) from error


def _alike(camera: str) -> IpsysError:
    return IpsysError(
        f"camera {camera}: the pictures do not tell the lens, for they show the board in too few ways; "
        "tilt it to all sides, and hold it near and far and all over the image"
    )


def _solved(camera: str, model: LensModel, corners: Corners, size_px: tuple[int, int], start: Fit) -> Solved:
    try:
        solved = solve(model, corners, size_px, start)
    except np.linalg.LinAlgError as error:
        raise _alike(camera) from error
    sigmas = np.sqrt(np.diag(solved.covariance))
    if not (np.isfinite(solved.fit.lens).all() and np.isfinite(sigmas).all()):
        raise _alike(camera)
    if (sigmas[:2] > _UNKNOWN * solved.fit.lens[:2]).any() or not tells_focal_length(solved):
        raise _alike(camera)
    return solved


def _two_cameras(
    model: LensModel, start: Fit, corners: Corners, used: list[Sighting], size_px: tuple[int, int]
) -> str:
    names = [sighting.name for sighting in used]
    split = find_two_cameras(model, start, corners, names)
    if split is None:
        return ""
    # Another lens model may explain the images without a second camera.
    better = find_better_model(model, corners, size_px, split.one_px)
    if better is not None and better.rms_px < split.two_px:
        return ""
    return f"{two_cameras_fault(split, names)}; put the pictures of each camera into a separate folder"


def _far_off(model: LensModel, solved: Solved, corners: Corners, size_px: tuple[int, int]) -> str:
    left_px = rms_px(solved)
    if left_px <= MOST_RMS_PX:
        return ""
    better = find_better_model(model, corners, size_px, left_px)
    todo = "check that the board is flat, that its size is right, and that all pictures are of one camera"
    if better is not None:
        todo = f"--lens {better.name} leaves {better.rms_px:.2f} px: use it"
    return f"the RMS reprojection error is {left_px:.1f} px, too large for a usable calibration; {todo}"


def _few_pictures(camera: str, used: list[Sighting], bad: list[Dropped], looked: Looked, insist: bool) -> str:
    """Return the fault of too few images, "" if there are enough; raise it unless the user insists."""
    if len(used) >= LEAST_PICTURES:
        return ""
    reasons = Counter(reason.split(":")[0] for _, reason in (*bad, *looked.unseen))
    reasons_text = (
        f" ({'; '.join(f'{n} x {reason}' for reason, n in reasons.most_common(3))})" if reasons else ""
    )
    todo = ["take at least 15, with the board all over the image and tilted to all sides"]
    if used:
        pixels = np.concatenate([s.pixels for s in used])
        coverage = measure_coverage(pixels, looked.size_px, np.stack([s.outline for s in used]))
        todo += [line.split(":")[0] for line in advice(coverage)[:1]]
    fault = (
        f"only {len(used)} of {looked.count} pictures can be used{reasons_text}, but a calibration needs "
        f"{LEAST_PICTURES} or more; {'; '.join(todo)}"
    )
    if insist and len(used) >= _LEAST_INSISTED:
        return fault
    raise IpsysError(f"camera {camera}: {fault}")


def _judged(
    camera: str,
    model: LensModel,
    looked: Looked,
    used: list[Sighting],
    solved: Solved,
    bad: list[Dropped],
    spare: list[Dropped],
    forced: tuple[str, ...],
) -> Calibrated:
    lens = solved.fit.lens
    k = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    width, height = looked.size_px
    distances = np.linalg.norm(solved.residuals_px, axis=1)
    counts = solved.corners.sums(np.ones_like(distances))
    each_px = np.sqrt(solved.corners.sums(distances**2) / counts)
    coverage = _covered(looked, used, solved)
    notes = _doubts(model, solved, looked.size_px)
    sigmas = np.sqrt(np.diag(solved.covariance))
    return Calibrated(
        camera,
        CameraCalibration(0, camera, width, height, model.distortion_model, lens[4:], k),
        model.names,
        lens,
        sigmas,
        solved.square,
        float(np.sqrt((distances**2).mean())),
        float(np.median(distances)),
        looked.count,
        len(looked.sightings),
        tuple((s.name, float(rms)) for s, rms in zip(used, each_px, strict=True)),
        tuple(bad),
        tuple(spare),
        looked.unseen,
        solved.far_corners,
        coverage,
        (*forced, *advice(coverage), *_unseen(looked), *notes, *_softness(used)),
        solved.corners.pixels,
        solved.residuals_px,
    )


def _covered(looked: Looked, used: list[Sighting], solved: Solved) -> Coverage:
    outlines = np.stack([s.outline for s in used])
    points_m = camera_points(solved.fit, solved.corners)
    normals = solved.fit.rotations[:, :, 2]
    return measure_coverage(solved.corners.pixels, looked.size_px, outlines, normals, points_m)


def _unseen(looked: Looked) -> list[str]:
    """Return a note if many images show another grid than the board."""
    others = Counter(reason for _, reason in looked.unseen if "instead" in reason)
    if sum(others.values()) <= _MANY_OTHERS * looked.count:
        return []
    reason, count = others.most_common(1)[0]
    return [f"in {count} of {looked.count} pictures {reason}: check --board"]


def _doubts(model: LensModel, solved: Solved, size_px: tuple[int, int]) -> list[str]:
    """Return notes on weak points of the result, from its numbers."""
    lens, sigmas, notes = solved.fit.lens, np.sqrt(np.diag(solved.covariance)), []
    left_px = rms_px(solved)
    if _TRY_OTHERS_PX < left_px <= MOST_RMS_PX:
        better = find_better_model(model, solved.corners, size_px, left_px)
        if better is not None:
            notes.append(
                f"the RMS reprojection error is {left_px:.2f} px; --lens {better.name} leaves "
                f"{better.rms_px:.2f} px: use it"
            )
        elif left_px > _OFF_PX:
            notes.append(f"the RMS reprojection error is {left_px:.1f} px: check that the board is flat")
    unsure = float((sigmas[:2] / lens[:2]).max())
    if unsure > _UNSURE:
        notes.append(
            f"the focal length is only known to {unsure:.1%}: add pictures with the board tilted and near"
        )
    if model.distortion_model == "rational_polynomial" and sigmas[4:].max() > _UNTOLD:
        notes.append("these pictures do not tell eight coefficients from one another: use --lens pinhole")
    return notes


def _softness(used: list[Sighting]) -> list[str]:
    soft_px = float(np.median([s.blur_px for s in used]))
    if soft_px < _SOFT_PX:
        return []
    return [
        f"edges are {soft_px:.1f} px wide in all pictures: more light, a shorter exposure or a sharper focus "
        "would help"
    ]


Progress = Callable[[str, int, int | None], None]


class Failure(NamedTuple):
    """A camera without a result: the reason in one line, and whether the user expects a result.

    The user expects no result for a camera of a log that never shows the board, unless the user names the
    camera.
    """

    camera: str
    reason: str
    expected: bool


def calibrate_cameras(
    sources: Sequence[Pictures],
    board: Board,
    model: LensModel,
    progress: Progress = lambda stage, done, total: None,
    insist: bool = False,
) -> Iterator[Calibrated | Failure]:
    """Calibrate each camera, and yield its result as soon as it is ready.

    Parameters
    ----------
    sources : the images of each camera.
    board, model : the board to search for, and the lens model.
    progress : called with the camera, the number of searched images, and their total.
    insist : accept the given board size, and poor results.
    """
    for pictures in sources:
        try:
            yield _calibrate_one(pictures, board, model, progress, insist)
        except IpsysError as error:
            expected = pictures.requested or not isinstance(error, NotSeenError)
            yield Failure(pictures.camera, str(error), expected)


def _calibrate_one(
    pictures: Pictures, board: Board, model: LensModel, progress: Progress, insist: bool
) -> Calibrated:
    camera, count = pictures.camera, pictures.looked_at or None
    progress(camera, 0, count)
    sizes = pictures.sizes()
    if sizes:
        check_sizes(sizes, pictures.where)
    looked = look(
        pictures.read(), board, pictures.total, pictures.where,
        lambda done: progress(camera, done, count),
        partial(progress, "other boards"),
        insist,
    )  # fmt: skip
    return calibrate(camera, looked, board, model, insist)
