"""Intrinsic calibration of one camera, or of several cameras separately."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting
from ipsys_log.calibration.board_search import (
    ExcludedSighting,
    ImageCoverage,
    NotSeenError,
    SearchResult,
    advise,
    check_sizes,
    measure_coverage,
    search_images,
    select_images,
)
from ipsys_log.calibration.bundle_adjustment import Corners, LensFit, camera_points
from ipsys_log.calibration.images import ImageSource
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.solve import SolveResult, determines_focal_length, find_start, rms_px, solve
from ipsys_log.calibration.two_cameras import (
    MOST_RMS_PX,
    find_better_model,
    find_two_cameras,
    two_cameras_fault,
)
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration

MIN_IMAGES = 5
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
class CalibrationResult:
    """The intrinsics of a camera and their quality.

    Attributes
    ----------
    camera, lens : name of the camera, and its intrinsics.
    names, values, sigmas : of the parameters; the standard deviations are 0 if not fitted.
    square : whether fx = fy was assumed.
    bending_m, bending_sigma_m : depth of the edges of the board behind its middle, in x and in y, and its
        standard deviation, (2,).
    rms_px, median_px : of the reprojection errors: the root of the mean of dx^2 + dy^2, over all corners of
        all used images.
    examined_count, seen : numbers of examined images, and of images that show the board.
    used : names and RMS in px of the images in the fit.
    dropped : bad images with the board that were left out, and the reasons.
    spare : good images that add no information.
    unseen : images without the board, and their contents.
    outlier_corners : number of single outlier corners that were left out of used images.
    coverage, notes : positions of the board, and advice.
    pixels, residuals_px : (n, 2), of all used corners.
    """

    camera: str
    lens: CameraCalibration
    names: tuple[str, ...]
    values: Array
    sigmas: Array
    square: bool
    bending_m: Array
    bending_sigma_m: Array
    rms_px: float
    median_px: float
    examined_count: int
    seen: int
    used: tuple[tuple[str, float], ...]
    dropped: tuple[ExcludedSighting, ...]
    spare: tuple[ExcludedSighting, ...]
    unseen: tuple[ExcludedSighting, ...]
    outlier_corners: int
    coverage: ImageCoverage
    notes: tuple[str, ...]
    pixels: Array
    residuals_px: Array

    def __repr__(self) -> str:
        used = f"{len(self.used)} of {self.examined_count} images"
        return f"<CalibrationResult of {self.camera}: {used}, reprojection RMS {self.rms_px:.3f} px>"


def calibrate(
    camera: str, search: SearchResult, board: Board, model: LensModel, force: bool = False
) -> CalibrationResult:
    """Estimate the intrinsics of a camera from its images.

    Parameters
    ----------
    camera, search, board, model : name of the camera, sightings, board, and lens model.
    force : return a result that is too poor to use, with a note that gives the reason.

    Raises
    ------
    IpsysError
        Too few images are usable, the images are of two cameras, or the reprojection error is large; the
        text says what to do.
    """
    chosen = select_images(search.sightings, board, search.size_px)
    used = chosen.used
    bad = [*search.unreadable, *chosen.bad]
    faults = [_few_images_fault(camera, used, bad, search, force)]
    corners = Corners(
        np.concatenate([board.points_m(s.ids) for s in used]),
        np.concatenate([s.pixels for s in used]),
        np.repeat(np.arange(len(used)), [len(s.ids) for s in used]),
        len(used),
    )
    start = _start(camera, model, corners, search.size_px)
    faults.append(_two_cameras(model, start, corners, used, search.size_px))
    _refuse(camera, faults, force)
    solved = _solve(camera, model, corners, search.size_px, start)
    bad += [ExcludedSighting(used[excluded.number].name, excluded.reason) for excluded in solved.excluded]
    fitted = [used[n] for n in solved.image_numbers]
    faults.append(_large_error_fault(model, solved, corners, search.size_px))
    _refuse(camera, faults, force)
    faults.append(_few_images_fault(camera, fitted, bad, search, force))
    notes = tuple(f"written only because of --force: {fault}" for fault in faults if fault)
    return _build_result(camera, model, search, fitted, solved, bad, chosen.spare, notes)


def _refuse(camera: str, faults: list[str], force: bool) -> None:
    for fault in faults:
        if fault and not force:
            raise IpsysError(f"camera {camera}: {fault}; or use --force")


def _start(camera: str, model: LensModel, corners: Corners, size_px: tuple[int, int]) -> LensFit:
    try:
        return find_start(model, corners, size_px)
    except np.linalg.LinAlgError as error:
        raise _too_similar_error(camera) from error


def _too_similar_error(camera: str) -> IpsysError:
    return IpsysError(
        f"camera {camera}: the intrinsics cannot be estimated, because the poses of the board are too "
        "similar; tilt it to all sides, near and far, in all parts of the image"
    )


def _solve(
    camera: str, model: LensModel, corners: Corners, size_px: tuple[int, int], start: LensFit
) -> SolveResult:
    try:
        solved = solve(model, corners, size_px, start)
    except np.linalg.LinAlgError as error:
        raise _too_similar_error(camera) from error
    sigmas = np.sqrt(np.diag(solved.covariance))
    if not (np.isfinite(solved.fit.intrinsics).all() and np.isfinite(sigmas).all()):
        raise _too_similar_error(camera)
    if (sigmas[:2] > _UNKNOWN * solved.fit.intrinsics[:2]).any() or not determines_focal_length(solved):
        raise _too_similar_error(camera)
    return solved


def _two_cameras(
    model: LensModel, start: LensFit, corners: Corners, used: list[BoardSighting], size_px: tuple[int, int]
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


def _large_error_fault(
    model: LensModel, solved: SolveResult, corners: Corners, size_px: tuple[int, int]
) -> str:
    error_px = rms_px(solved)
    if error_px <= MOST_RMS_PX:
        return ""
    better = find_better_model(model, corners, size_px, error_px)
    todo = "check that the board is flat, that its size is right, and that all pictures are of one camera"
    if better is not None:
        todo = f"use --lens {better.name}, with an error of {better.rms_px:.2f} px"
    return f"the RMS reprojection error is {error_px:.1f} px, too large for a usable calibration; {todo}"


def _few_images_fault(
    camera: str, used: list[BoardSighting], bad: list[ExcludedSighting], search: SearchResult, force: bool
) -> str:
    """Return the fault of too few images, "" if there are enough; raise it unless the user insists."""
    if len(used) >= MIN_IMAGES:
        return ""
    reasons = Counter(reason.split(":")[0] for _, reason in (*bad, *search.unseen))
    reasons_text = (
        f" ({'; '.join(f'{n} x {reason}' for reason, n in reasons.most_common(3))})" if reasons else ""
    )
    todo = ["take at least 15, with the board in all parts of the image and tilted to all sides"]
    if used:
        pixels = np.concatenate([s.pixels for s in used])
        coverage = measure_coverage(pixels, search.size_px, np.stack([s.outline for s in used]))
        todo += [line.split(":")[0] for line in advise(coverage)[:1]]
    fault = (
        f"only {len(used)} of {search.count} pictures can be used{reasons_text}, but a calibration needs "
        f"{MIN_IMAGES} or more; {'; '.join(todo)}"
    )
    if force and len(used) >= _LEAST_INSISTED:
        return fault
    raise IpsysError(f"camera {camera}: {fault}")


def _build_result(
    camera: str,
    model: LensModel,
    search: SearchResult,
    used: list[BoardSighting],
    solved: SolveResult,
    bad: list[ExcludedSighting],
    spare: list[ExcludedSighting],
    forced: tuple[str, ...],
) -> CalibrationResult:
    lens = solved.fit.intrinsics
    k = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    width, height = search.size_px
    distances = np.linalg.norm(solved.residuals_px, axis=1)
    counts = solved.corners.sums(np.ones_like(distances))
    each_px = np.sqrt(solved.corners.sums(distances**2) / counts)
    coverage = _measure_coverage(search, used, solved)
    notes = _doubts(model, solved, search.size_px)
    sigmas = np.sqrt(np.diag(solved.covariance))
    return CalibrationResult(
        camera,
        CameraCalibration(0, camera, width, height, model.distortion_model, lens[4:], k),
        model.names,
        lens,
        sigmas,
        solved.square,
        solved.fit.bending_m,
        solved.bending_sigma_m,
        float(np.sqrt((distances**2).mean())),
        float(np.median(distances)),
        search.count,
        len(search.sightings),
        tuple((s.name, float(rms)) for s, rms in zip(used, each_px, strict=True)),
        tuple(bad),
        tuple(spare),
        search.unseen,
        solved.outlier_corners,
        coverage,
        (*forced, *advise(coverage), *_unseen(search), *notes, *_softness(used)),
        solved.corners.pixels,
        solved.residuals_px,
    )


def _measure_coverage(search: SearchResult, used: list[BoardSighting], solved: SolveResult) -> ImageCoverage:
    outlines = np.stack([s.outline for s in used])
    points_m = camera_points(solved.fit, solved.corners)
    normals = solved.fit.rotations[:, :, 2]
    return measure_coverage(solved.corners.pixels, search.size_px, outlines, normals, points_m)


def _unseen(search: SearchResult) -> list[str]:
    """Return a note if many images show another grid than the board."""
    others = Counter(reason for _, reason in search.unseen if "instead" in reason)
    if sum(others.values()) <= _MANY_OTHERS * search.count:
        return []
    reason, count = others.most_common(1)[0]
    return [f"in {count} of {search.count} pictures {reason}: check --board"]


def _doubts(model: LensModel, solved: SolveResult, size_px: tuple[int, int]) -> list[str]:
    """Return notes on weak points of the result, from its numbers."""
    lens, sigmas, notes = solved.fit.intrinsics, np.sqrt(np.diag(solved.covariance)), []
    error_px = rms_px(solved)
    if _TRY_OTHERS_PX < error_px <= MOST_RMS_PX:
        better = find_better_model(model, solved.corners, size_px, error_px)
        if better is not None:
            notes.append(
                f"the RMS reprojection error is {error_px:.2f} px; with --lens {better.name} it is "
                f"{better.rms_px:.2f} px: use this lens model"
            )
        elif error_px > _OFF_PX:
            notes.append(f"the RMS reprojection error is {error_px:.1f} px: check that the board is flat")
    unsure = float((sigmas[:2] / lens[:2]).max())
    if unsure > _UNSURE:
        notes.append(
            f"the focal length is uncertain ({unsure:.1%}): add pictures with the board tilted and near"
        )
    if model.distortion_model == "rational_polynomial" and sigmas[4:].max() > _UNTOLD:
        notes.append("eight coefficients cannot be estimated from these pictures: use --lens pinhole")
    return notes


def _softness(used: list[BoardSighting]) -> list[str]:
    soft_px = float(np.median([s.blur_px for s in used]))
    if soft_px < _SOFT_PX:
        return []
    return [
        f"edges are {soft_px:.1f} px wide in all pictures: add light, shorten the exposure, or correct the "
        "focus"
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
    sources: Sequence[ImageSource],
    board: Board,
    model: LensModel,
    progress: Progress = lambda stage, done, total: None,
    force: bool = False,
) -> Iterator[CalibrationResult | Failure]:
    """Calibrate each camera, and yield its result as soon as it is ready.

    Parameters
    ----------
    sources : the images of each camera.
    board, model : the board to search for, and the lens model.
    progress : called with the camera, the number of searched images, and their total.
    force : accept the given board size, and poor results.
    """
    for images in sources:
        try:
            yield _calibrate_one(images, board, model, progress, force)
        except IpsysError as error:
            expected = images.requested or not isinstance(error, NotSeenError)
            yield Failure(images.camera, str(error), expected)


def _calibrate_one(
    images: ImageSource, board: Board, model: LensModel, progress: Progress, force: bool
) -> CalibrationResult:
    camera, count = images.camera, images.examined_count or None
    progress(camera, 0, count)
    sizes = images.sizes()
    if sizes:
        check_sizes(sizes, images.source)
    search = search_images(
        images.read(), board, images.total, images.source,
        lambda done: progress(camera, done, count),
        partial(progress, "other boards"),
        force,
    )  # fmt: skip
    return calibrate(camera, search, board, model, force)
