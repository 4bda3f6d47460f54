"""Prints whose cells contradict every id: no path of the detection may measure them."""

from __future__ import annotations

import numpy as np
import pytest

from ipsys_log.messages import Event, Markers
from ipsys_log.stages.detect import Detect
from ipsys_log.stages.detect.uneven_light import CELL_SAMPLES, count_contradictions
from ipsys_log.vision.markers import white_cells
from tests.stages.drawing import (
    VGA,
    Array,
    Cells,
    Look,
    Print,
    at_px,
    calibrated,
    detect,
    draw,
    each_time,
    frame,
    jpeg,
    rig,
)

DICTIONARY = "DICT_4X4_100"
BLACK, WHITE = Look.black, Look.white


def marker(covered: Cells) -> Print:
    return at_px(VGA, 5, (330, 240), 2.0, length_m=0.4)._replace(covered=covered)


def inner_cells(is_white: bool) -> list[tuple[int, int]]:
    inner = np.argwhere(white_cells(DICTIONARY, 5)[1:-1, 1:-1] == is_white) + 1
    return [(int(row), int(column)) for row, column in inner]


def exchanged(count: int, seed: int) -> Cells:
    """Return inner cells with the opposite colour."""
    cells = [(cell, WHITE) for cell in inner_cells(False)] + [(cell, BLACK) for cell in inner_cells(True)]
    picked = np.random.default_rng(seed).choice(len(cells), count, replace=False)
    return dict(cells[n] for n in picked)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_one_cell_of_the_other_colour_is_no_marker(count: int) -> None:
    for seed in range(6):
        picture = draw(VGA, [marker(exchanged(count, seed))], Look(seed=seed))
        assert [m.id for m in detect(VGA, jpeg(picture))] == []


def test_wrong_cells_in_a_gradient_of_the_light_count_too() -> None:
    shade: Array = np.linspace(1.2, 0.3, VGA.width)[None].repeat(VGA.height, axis=0)
    for seed in range(6):
        picture = draw(VGA, [marker(exchanged(2, seed))], Look(seed=seed, shade=shade))
        assert detect(VGA, jpeg(picture)) == ()
    assert [m.id for m in detect(VGA, jpeg(draw(VGA, [marker({})], Look(shade=shade))))] == [5]


@pytest.mark.parametrize("level", [100.0, 130.0, 255.0])
@pytest.mark.parametrize("is_white", [False, True])
def test_one_covered_cell_is_a_marker(level: float, is_white: bool) -> None:
    """A cover is between black and white, and glare is brighter than the print's white."""
    for cell in inner_cells(is_white)[:2]:
        picture = draw(VGA, [marker({cell: level})], Look())
        assert [m.id for m in detect(VGA, jpeg(picture))] == [5]


def test_tracked_marker_whose_cell_turns_black_is_rejected() -> None:
    step = Detect("edges")
    for message in (rig(), calibrated(VGA)):
        list(step(message))
    pictures = [draw(VGA, [marker(cells)], Look()) for cells in ({}, {inner_cells(True)[0]: BLACK})]
    payloads = [
        payload
        for picture, time_ns in zip((pictures[0], pictures[1], pictures[1]), each_time(3), strict=True)
        for payload in step(frame(jpeg(picture), time_ns))
    ]
    assert [len(p.markers) for p in payloads if isinstance(p, Markers)] == [1, 0, 0]
    events = [p for p in payloads if isinstance(p, Event)]
    assert [(event.kind, event.marker_id) for event in events] == [("rejected_marker", 5)]
    assert "a shadow or an object hides some of its cells" in events[0].text


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_5X5_50", "DICT_6X6_250", "DICT_APRILTAG_16h5"])
def test_random_cells_contradict_every_id(dictionary: str) -> None:
    rng = np.random.default_rng(3)
    cells = len(white_cells(dictionary, 0))
    for _ in range(200):
        print_ = np.zeros((cells, cells), dtype=bool)
        print_[1:-1, 1:-1] = rng.random((cells - 2, cells - 2)) < 0.5
        levels = np.where(print_, 205.0, 35.0) * rng.uniform(0.3, 1.0)
        samples = levels.ravel() + rng.normal(0, 2, (len(CELL_SAMPLES), cells * cells))
        for marker_id in range(30):
            differ = int((white_cells(dictionary, marker_id) != print_).sum())
            if differ <= 6:  # what the other conditions may let through
                assert bool(count_contradictions(samples, dictionary, marker_id)) == bool(differ)
