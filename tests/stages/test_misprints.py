"""Prints that are no markers of the rig: what they are, and what the detection says about them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.capture.live_check import CameraMonitor
from ipsys_log.messages import Event, Markers, Message, Rig
from ipsys_log.stages.detect import Detect
from ipsys_log.stages.detect.misprints import find_misprints
from ipsys_log.stages.detect.search import find_squares
from tests.conftest import ROOT, Ipsys
from tests.stages.drawing import (
    VGA,
    Look,
    Picture,
    at_px,
    calibrated,
    draw,
    each_time,
    frame,
    jpeg,
    rig,
    strewn,
    texture,
    tiles,
)

RIG_50 = "DICT_4X4_50"
MIRRORED, OTHER = "mirrored_camera", "other_prints"


def lab(*ids: int, dictionary: str = RIG_50, cells: int = 6) -> Picture:
    places = [(130, 120), (330, 130), (520, 120), (140, 350), (330, 360), (520, 350)]
    prints = [
        at_px(VGA, n, place, 2.0, heading_rad=0.4 * n, length_m=0.055 * cells)
        for n, place in zip(ids, places, strict=False)
    ]
    return draw(VGA, prints, Look(dictionary=dictionary))


def mirrored(picture: Picture) -> Picture:
    return np.ascontiguousarray(picture[:, ::-1])


def negative() -> Picture:
    """Return white prints on a black margin; the floor is grey."""
    return draw(VGA, [at_px(VGA, n, (150 + 160 * n, 240), length_m=0.33) for n in range(3)], NEGATIVE)


NEGATIVE = Look(black=205.0, white=35.0, dictionary=RIG_50)


def wide() -> Picture:
    """Return prints with a black border of two cells."""
    picture = np.full((VGA.height, VGA.width), 150, dtype=np.uint8)
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for n in range(3):
        image = cv2.aruco.generateImageMarker(known, n, 96, borderBits=2)
        page = np.pad(np.where(image > 0, 205, 35), 12, constant_values=205)
        picture[150:270, 60 + 180 * n : 180 + 180 * n] = page
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), dtype=np.uint8)


def payloads(pictures: Iterable[Picture], corners: str = "edges", step_ns: int = 33_333_333) -> list[object]:
    step = Detect(corners)
    messages: list[Message] = [rig(dictionary=RIG_50), calibrated(VGA)]
    messages += [
        frame(jpeg(picture), t) for t, picture in zip(each_time(99, step_ns), pictures, strict=False)
    ]
    return [payload for message in messages for payload in step(message)]


def ids(made: Iterable[object]) -> list[list[int]]:
    return [[marker.id for marker in one.markers] for one in made if isinstance(one, Markers)]


def events(made: Iterable[object]) -> list[tuple[str, str]]:
    return [(one.kind, one.text) for one in made if isinstance(one, Event)]


@pytest.mark.parametrize("corners", ["edges", "stock"])
def test_mirrored_camera_gives_no_markers(corners: str) -> None:
    """The mirror images of the ids 8, 9 and 17 are these ids again."""
    made = payloads([mirrored(lab(3, 8, 9, 17))] * 3, corners)
    assert ids(made) == [[], [], []]
    ((kind, text),) = events(made)
    assert kind == MIRRORED
    assert "the image is mirrored" in text


def test_mirrored_camera_stays_without_markers_after_a_reset() -> None:
    first = payloads([mirrored(lab(3, 4, 5)), *[mirrored(lab(8, 9))] * 2])
    assert ids(first) == [[], [], []]


def test_symmetric_markers_of_a_right_camera_are_measured() -> None:
    made = payloads([lab(3, 8, 9, 17)] * 3)
    assert ids(made) == [[3, 8, 9, 17]] * 3
    assert events(made) == []


@pytest.mark.parametrize("corners", ["edges", "stock"])
@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (lambda: lab(3, 7, 20, dictionary="DICT_5X5_50", cells=7), 'dictionary = "DICT_5X5_50"'),
        (lambda: lab(3, 70, 20, dictionary="DICT_6X6_250", cells=8), 'dictionary = "DICT_6X6_100"'),
        (lambda: lab(3, 70, 20, dictionary="DICT_APRILTAG_36h11", cells=8), "DICT_APRILTAG_36h11"),
        (lambda: lab(170, 300, 120, dictionary="DICT_4X4_1000"), 'dictionary = "DICT_4X4_1000"'),
        (negative, "negatives of DICT_4X4_50"),
        (wide, "border of two cells"),
    ],
    ids=["5x5", "6x6", "36h11", "4x4 1000", "negative", "wide"],
)
def test_prints_of_another_kind_are_named(picture: object, words: str, corners: str) -> None:
    assert callable(picture)
    made = payloads([picture()] * 3, corners)
    assert ids(made) == [[], [], []]
    ((kind, text),) = events(made)
    assert kind == OTHER
    assert words in text


def test_other_prints_beside_a_marker_are_no_event() -> None:
    """A lab may have markers of another system."""
    picture = lab(3, 7, 20, dictionary="DICT_5X5_50", cells=7)
    picture[240:] = lab(1, 2, 4, 5, 6, 10)[240:]
    made = payloads([picture] * 3)
    assert ids(made) == [[5, 6, 10]] * 3
    assert OTHER not in dict(events(made))


def random_page(rng: np.random.Generator, cells: int) -> Picture:
    """Return 24 sharp squares with a black border and random cells."""
    picture = np.full((VGA.height, VGA.width), 205, dtype=np.uint8)
    for n in range(24):
        x, y, side = 20 + 102 * (n % 6), 20 + 115 * (n // 6), 9 * (cells + 2)
        square = np.full((cells + 2, cells + 2), 35, dtype=np.uint8)
        square[1:-1, 1:-1] = rng.choice([35, 205], (cells, cells))
        picture[y : y + side, x : x + side] = square.repeat(9, axis=0).repeat(9, axis=1)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), dtype=np.uint8)


def test_random_squares_are_no_prints_of_a_dictionary() -> None:
    """One of 16 random squares with 4x4 cells is an id of DICT_4X4_1000."""
    rng = np.random.default_rng(0)
    pages = [random_page(rng, cells) for cells in (4, 5, 6) for _ in range(25)]
    assert [page for page in pages if find_misprints(page, RIG_50, find_squares(page)) is not None] == []


def test_prints_of_another_dictionary_among_random_squares_are_named() -> None:
    page = random_page(np.random.default_rng(1), 4)
    page[240:] = lab(3, 7, 20, 30, 31, 32, dictionary="DICT_5X5_50", cells=7)[240:]
    misprints = find_misprints(page, RIG_50, find_squares(page))
    assert misprints is not None
    assert 'dictionary = "DICT_5X5_50"' in misprints.advice


def test_rejections_of_other_prints_that_come_later_are_no_event() -> None:
    """An unreadable print resembles an id of the rig; it comes between two inspections of whole images."""
    floor = np.full((VGA.height, VGA.width), 150, dtype=np.uint8)
    other = lab(22, 1, 30, 25, 37, 38, dictionary="DICT_6X6_50", cells=8)
    assert [kind for kind, _ in events(payloads([floor] * 25 + [other] * 10))] == [OTHER]


@pytest.mark.parametrize("own", [1, 5])
def test_live_check_names_other_prints_if_they_are_more(own: int) -> None:
    """A single print of another dictionary can have the cells of a marker of the rig."""
    picture = lab(*range(own), dictionary=RIG_50)
    others = lab(*range(10, 16), dictionary="DICT_5X5_50", cells=7)
    x_px = 215 if own == 1 else 425
    picture[:, x_px:] = others[:, x_px:]
    if own == 1:
        picture[240:] = others[240:]
    check = CameraMonitor(Rig("lab", RIG_50, 0.2))._check("red", frame(jpeg(picture), 1).payload)
    assert check.markers
    assert any("DICT_5X5_50" in text for text in check.warnings) == (own == 1)


def test_squares_without_a_pattern_are_no_prints() -> None:
    rng = np.random.default_rng(0)
    pictures: list[Picture] = [
        draw(VGA, [], Look(floor=tiles(VGA))),
        draw(VGA, [], Look(floor=texture(VGA, 2))),
    ]
    boxes = np.full((VGA.height, VGA.width), 150, dtype=np.uint8)
    for _ in range(60):
        x, y, side = rng.integers(0, 560), rng.integers(0, 420), rng.integers(20, 80)
        boxes[y : y + side, x : x + side] = rng.integers(0, 255)
    for picture in [*pictures, boxes]:
        assert find_misprints(picture, RIG_50, find_squares(picture)) is None
    assert events(payloads(pictures)) == []


def test_random_cells_are_no_mirrored_camera() -> None:
    """A foreign print can have the cells of a mirrored id by chance: the first marker corrects it."""
    look = Look(dictionary=RIG_50)
    alone = strewn(VGA, 1, np.random.default_rng(0), look, length_m=0.33)[0]
    foreign = mirrored(draw(VGA, [alone._replace(id=5)], look))
    made = payloads([foreign, lab(1, 2, 4), lab(1, 2, 4)], step_ns=5_000_000_000)
    assert ids(made)[1:] == [[1, 2, 4]] * 2


CASES = {
    "mirrored_camera": "mirrored",
    "wrongdic": 'dictionary = "DICT_5X5_',
    "inverted_print": "negatives",
    "border2": "border of two cells",
    "foreign": 'dictionary = "DICT_4X4_',
}


@pytest.mark.parametrize("rig_name", ["own", "four"])
@pytest.mark.parametrize("case", CASES)
def test_faulty_prints_of_the_shared_cases(ipsys: Ipsys, tmp_path: Path, case: str, rig_name: str) -> None:
    folder = Path(os.environ.get("IPSYS_CASES", ROOT / "../shared/cases")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no faulty inputs in {folder}: set IPSYS_CASES")
    own = {"foreign": "rnd"}.get(case, case)
    log = tmp_path / "lab.mcap"
    rig_file = folder / "markers" / f"{own if rig_name == 'own' else rig_name}.toml"
    lens = f"red={folder / 'calibration' / 'good.yaml'}"
    images = folder / "markers" / case
    ipsys("import", "images", images, "-o", log, "--rig", rig_file, "--calibration", lens)
    answer = ipsys("detect", log)
    assert answer.code == 1
    assert CASES[case] in " ".join(answer.err.split())
