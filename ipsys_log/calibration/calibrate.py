"""The lens of a camera from pictures of a board: look, choose, solve, judge."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.boards import Board
from ipsys_log.calibration.bundle import Corners, camera_points
from ipsys_log.calibration.choose import Dropped, choose
from ipsys_log.calibration.coverage import Coverage, advice, measure_coverage
from ipsys_log.calibration.hints import hint
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.sighting import Grey, Sighting, find_board
from ipsys_log.calibration.solve import Solved, solve
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration

__all__ = ["LEAST_PICTURES", "Calibrated", "Looked", "calibrate", "look"]

Array = NDArray[np.float64]

LEAST_PICTURES = 6
# Up to so many pictures are looked at thoroughly: more come from a video, which has others.
_THOROUGH = 100
_HINTED = 8
# A focal length less sure than this is said to be so; coefficients are worth nothing beyond theirs.
_UNSURE = 0.02
_UNTOLD = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What was seen of the board: pictures looked at, their size, the sightings, and what was unreadable."""

    count: int
    size_px: tuple[int, int]
    sightings: tuple[Sighting, ...]
    unreadable: tuple[Dropped, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """A lens and how good it is.

    Attributes
    ----------
    camera, lens : whose, and the lens.
    names, values, sigmas : of its parameters, with their standard deviations; 0 of what was not fitted.
    square : whether fx and fy were taken for one number.
    rms_px, median_px : of the distances, in the image, between corners seen and projected: the root of the mean
        of dx^2 + dy^2, over all corners of all pictures used.
    looked, seen : pictures looked at, and those in which the board was seen.
    used : names and RMS in px of the pictures that the lens rests on.
    dropped : pictures with the board that were left out because they are bad, and why.
    spare : good pictures that show nothing new.
    far_corners : single corners left out of pictures used.
    coverage, notes : where the board was, and what to do better.
    pixels, residuals_px : (n, 2), of all corners used.
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
    far_corners: int
    coverage: Coverage
    notes: tuple[str, ...]
    pixels: Array
    residuals_px: Array


def look(
    pictures: Iterable[tuple[str, Grey | None]],
    board: Board,
    total: int,
    where: str,
    progress: Callable[[int], None] = lambda done: None,
) -> Looked:
    """Look for the board in all pictures.

    Parameters
    ----------
    pictures : names and grey pictures, None for one that cannot be read.
    board : what to look for.
    total : how many there are about; 0 where that is not known.
    where : they come from, for messages.
    progress : called with the pictures done.

    Raises
    ------
    IpsysError
        Where pictures are of different sizes, or the board is in none of them.
    """
    size: tuple[int, int] | None = None
    first, count = "", 0
    sightings, unreadable, some = [], [], []
    for name, grey in pictures:
        count += 1
        if grey is None:
            unreadable.append(Dropped(name, "cannot be read"))
            continue
        here = (grey.shape[1], grey.shape[0])
        if size is not None and here != size:
            raise IpsysError(
                f"{where}: {name} is {here[0]} x {here[1]} px and {first} is {size[0]} x {size[1]}; "
                "a lens is calibrated at one size: take out one kind"
            )
        size, first = here, first or name
        sighting = find_board(name, grey, board, thorough=0 < total <= _THOROUGH)
        if sighting is not None:
            sightings.append(sighting)
        elif not sightings:
            _remember(some, grey, count, total)
        progress(count)
    if size is None:
        raise IpsysError(f"{where}: none of {count} pictures can be read")
    if not sightings:
        found = hint(some, board)
        raise IpsysError(f"{where}: {board} is not seen in any of {count} pictures{found}")
    return Looked(count, size, tuple(sightings), tuple(unreadable))


def _remember(some: list[Grey], grey: Grey, count: int, total: int) -> None:
    """Keep a few pictures, spread over all of them, to find out what they show instead."""
    if count % max(1, total // _HINTED) == 0 or total <= _HINTED:
        some.append(grey)
        if len(some) > 2 * _HINTED:
            del some[::2]


def calibrate(camera: str, looked: Looked, board: Board, model: LensModel) -> Calibrated:
    """The lens that the pictures tell.

    Raises
    ------
    IpsysError
        Where too few pictures are of use; it says what to add.
    """
    chosen = choose(looked.sightings, board, looked.size_px)
    used = chosen.used
    bad = [*looked.unreadable, *chosen.bad]
    _check_enough(camera, used, bad, looked)
    corners = Corners(
        np.concatenate([board.points_m(s.ids) for s in used]),
        np.concatenate([s.pixels for s in used]),
        np.repeat(np.arange(len(used)), [len(s.ids) for s in used]),
        len(used),
    )
    solved = solve(model, corners, looked.size_px)
    bad += [Dropped(used[left.picture].name, left.reason) for left in solved.left]
    used = [used[n] for n in solved.pictures]
    _check_enough(camera, used, bad, looked)
    return _judged(camera, model, looked, used, solved, bad, chosen.spare)


def _check_enough(camera: str, used: list[Sighting], bad: list[Dropped], looked: Looked) -> None:
    if len(used) >= LEAST_PICTURES:
        return
    reasons = Counter(reason.split(":")[0] for _, reason in bad)
    why = f" ({'; '.join(f'{n} x {reason}' for reason, n in reasons.most_common(3))})" if reasons else ""
    todo = ["take at least 15, with the board all over the image and tilted to all sides"]
    if used:
        pixels = np.concatenate([s.pixels for s in used])
        coverage = measure_coverage(pixels, looked.size_px, np.stack([s.outline for s in used]))
        todo += [line.split(":")[0] for line in advice(coverage)[:1]]
    raise IpsysError(
        f"camera {camera}: {len(used)} of {looked.count} pictures are of use{why}, and "
        f"{LEAST_PICTURES} are the least; {'; '.join(todo)}"
    )


def _judged(
    camera: str,
    model: LensModel,
    looked: Looked,
    used: list[Sighting],
    solved: Solved,
    bad: list[Dropped],
    spare: list[Dropped],
) -> Calibrated:
    lens = solved.fit.lens
    k = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    width, height = looked.size_px
    distances = np.linalg.norm(solved.residuals_px, axis=1)
    counts = solved.corners.sums(np.ones_like(distances))
    each_px = np.sqrt(solved.corners.sums(distances**2) / counts)
    coverage = measure_coverage(
        solved.corners.pixels,
        looked.size_px,
        np.stack([s.outline for s in used]),
        solved.fit.rotations[:, :, 2],
        camera_points(solved.fit, solved.corners),
    )
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
        solved.far_corners,
        coverage,
        (*advice(coverage), *_doubts(model, lens, sigmas)),
        solved.corners.pixels,
        solved.residuals_px,
    )


def _doubts(model: LensModel, lens: Array, sigmas: Array) -> list[str]:
    """What the numbers themselves say against the lens."""
    notes = []
    unsure = float((sigmas[:2] / lens[:2]).max())
    if unsure > _UNSURE:
        notes.append(f"the focal length is only known to {unsure:.1%}: add pictures with the board tilted and near")
    if model.distortion_model == "rational_polynomial" and sigmas[4:].max() > _UNTOLD:
        notes.append("these pictures do not tell eight coefficients from one another: use --lens pinhole")
    return notes
