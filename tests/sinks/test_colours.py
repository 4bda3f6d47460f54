"""Colours of many cameras and robots: all different, and the first ones as before."""

from __future__ import annotations

import colorsys
from itertools import combinations

import numpy as np
import pytest

from ipsys_log.app.report.styles import camera_styles, to_rgb
from ipsys_log.capture.simulation.settings import grid_names
from ipsys_log.sinks.colours import camera_colours, oklab, robot_colour

# Red and the orange of Okabe and Ito, which are easy to tell apart, have a distance of 0.16.
LEAST_APART = 0.08


def closest(colours: list[tuple[int, int, int]]) -> float:
    places = oklab(np.array(colours))
    return min(float(np.linalg.norm(one - other)) for one, other in combinations(places, 2))


@pytest.mark.parametrize("count", [3, 6, 24, 40])
def test_colours_of_many_cameras_can_be_told_apart(count: int) -> None:
    names = grid_names(8, 5)[:count]
    assert closest(list(camera_colours(names).values())) > LEAST_APART
    assert closest([to_rgb(colour) for colour, _ in camera_styles(names).values()]) > LEAST_APART


def test_colours_of_twelve_robots_can_be_told_apart() -> None:
    assert closest([robot_colour(number) for number in range(12)]) > LEAST_APART


def test_further_colours_are_visible_on_their_background() -> None:
    """The lightness by another road: HLS of the colours on paper and on a dark background."""
    names = grid_names(6, 4)
    for colour in list(camera_colours(names).values())[6:]:
        assert max(colour) > 110
    for text, _ in list(camera_styles(names).values())[8:]:
        assert colorsys.rgb_to_hls(*(value / 255 for value in to_rgb(text)))[1] < 0.85


def test_few_cameras_keep_their_colours() -> None:
    assert camera_colours(["red", "white", "black"]) == {
        "black": (110, 110, 120),
        "red": (235, 95, 60),
        "white": (240, 240, 240),
    }
    assert camera_colours(["b", "a"]) == {"a": (70, 150, 235), "b": (230, 159, 0)}
    assert camera_styles(["red", "left"]) == {"left": ("#0072B2", "o"), "red": ("#D55E00", "s")}
    first_eight = [camera_styles([f"c{n}" for n in range(8)])[f"c{n}"][0] for n in range(8)]
    assert first_eight == [
        *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9", "#8C8C8C")
    ]


def test_order_of_the_cameras_does_not_matter() -> None:
    names = grid_names(6, 4)
    assert camera_colours(names) == camera_colours(reversed(names))
