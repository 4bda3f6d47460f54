"""Faults of prints, patterns and images that no rig explains: see ``contradictions.py``."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from fault_trials import Fault, Outcome, Trial, cases_folder
from numpy.typing import NDArray

__all__ = ["FAULTS"]

# Random squares: in a grid on each of some images, (columns, rows), with cells of this size.
_IMAGES, _COLUMNS, _ROWS, _CELL_PX = 10, 8, 4, 10
_FINER = 4
_RIG = 'name = "lab"\ndictionary = "{}"\nmarker_length_m = 0.15\n[[cameras]]\nname = "red"\n'


def _answer(trial: Trial, images: Path, rig: Path) -> tuple[str, int]:
    """Return the output of the detection in a folder of images, and the number of accepted markers."""
    lens = f"red={cases_folder() / 'calibration' / 'good.yaml'}"
    log = trial.folder / "lab.mcap"
    trial.ipsys("import", "images", images, "-o", log, "--rig", rig, "--calibration", lens)
    answer = trial.ipsys("detect", log, "--skip-ambiguous")
    count = re.search(r"(\d+) markers in \d+ frames", answer)
    return answer, int(count[1]) if count else 0


def _shared(case: str, words: str, rig: str = "") -> Callable[[Trial], Outcome]:
    """Return the trial of a case of the folder: its fault is named with these words, without any marker."""

    def attempt(trial: Trial) -> Outcome:
        markers = cases_folder() / "markers"
        answer, accepted = _answer(trial, markers / case, markers / f"{rig or case}.toml")
        return Outcome(not accepted and words in answer, figure=f"{accepted} prints accepted")

    return attempt


def _random_cells(dictionary: str, size: int) -> Callable[[Trial], Outcome]:
    """Return a trial of squares with random cells, none of which has the cells of an id."""
    ids = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))

    def attempt(trial: Trial) -> Outcome:
        rng = np.random.default_rng(trial.seed)
        images = trial.folder / "images"
        (images / "red").mkdir(parents=True)
        for n in range(_IMAGES):
            cv2.imwrite(str(images / "red" / f"{n:04}.png"), _page(rng, size, ids))
        rig = trial.folder / "lab.toml"
        rig.write_text(_RIG.format(dictionary))
        _, accepted = _answer(trial, images, rig)
        count = _IMAGES * _COLUMNS * _ROWS
        return Outcome(not accepted, figure=f"{accepted} of {count} accepted")

    return attempt


def _foreign_cells(rng: np.random.Generator, size: int, ids: cv2.aruco.Dictionary) -> NDArray[np.uint8]:
    """Draw random cells until they are not those of an id."""
    while True:
        cells = rng.integers(0, 2, (size, size), dtype=np.uint8)
        if not ids.identify(cells, 0.0)[0]:
            return cells


def _page(rng: np.random.Generator, size: int, ids: cv2.aruco.Dictionary) -> NDArray[np.uint8]:
    """Draw squares with ``size`` x ``size`` random cells in a black border, 1280 x 720."""
    page = np.full((720 * _FINER, 1280 * _FINER), 200, dtype=np.float32)
    side_px = (size + 2) * _CELL_PX
    for n in range(_COLUMNS * _ROWS):
        row, column = divmod(n, _COLUMNS)
        cells = np.pad(_foreign_cells(rng, size, ids), 1)
        image = np.where(cells > 0, 205, 35).astype(np.float32).repeat(20, axis=0).repeat(20, axis=1)
        angle, middle = rng.uniform(-0.2, 0.2), np.array([80, 90])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side_px / 2
        to_px = ((square @ turn.T + middle + rng.uniform(-0.5, 0.5, 2)) * _FINER).astype(np.float32)
        from_px = (np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * len(image) - 0.5).astype(np.float32)
        matrix = cv2.getPerspectiveTransform(from_px, to_px)
        tile = page[180 * row * _FINER :, 160 * column * _FINER :][: 180 * _FINER, : 160 * _FINER]
        tile[:] = cv2.warpPerspective(
            image, matrix, (tile.shape[1], tile.shape[0]), None, cv2.INTER_LINEAR, cv2.BORDER_CONSTANT, 200
        )
    blurred = cv2.GaussianBlur(page, (0, 0), 0.7 * _FINER)
    small = cv2.resize(blurred, (1280, 720), interpolation=cv2.INTER_AREA)
    noisy = small + rng.normal(0, 2, small.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


FAULTS: Sequence[Fault] = (
    Fault("prints: random cells, 4x4", _random_cells("DICT_4X4_50", 4), is_random=True),
    Fault("prints: random cells, 5x5", _random_cells("DICT_5X5_50", 5), is_random=True),
    Fault("prints: foreign ids", _shared("foreign", "DICT_4X4_", "rnd")),
    Fault("prints: foreign ids, four robots", _shared("foreign", "DICT_4X4_", "four")),
    Fault("prints: mirrored camera", _shared("mirrored_camera", "mirrored")),
    Fault("prints: another dictionary", _shared("wrongdic", 'dictionary = "DICT_5X5_')),
    Fault("prints: negatives", _shared("inverted_print", "negative")),
    Fault("prints: border of two cells", _shared("border2", "border of two cells")),
)
