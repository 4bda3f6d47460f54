"""Glare and shadows on the markers of drawn frames, placed on each print by its own coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.messages import CameraCalibration
from tests.stages.drawing import (
    VGA,
    Array,
    Look,
    Picture,
    Print,
    _project,
    at_px,
    corners_px,
    draw,
    jpeg,
    strewn,
)

# Corners in sides of the square, clockwise from the top left.
_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])

# The light of a print: added light, and the remaining share of the light, (h, w) each.
Light = Callable[[CameraCalibration, Print, np.random.Generator], tuple[Array | float, Array | float]]


def lit_frame(
    lens: CameraCalibration,
    light: Light,
    seed: int,
    length_m: float = 0.2,
    count: int = 5,
) -> tuple[bytes, dict[int, Array]]:
    """Return a JPEG of markers at random positions with a given lighting, and their corners in px by id."""
    rng, look = np.random.default_rng(seed), Look(seed=seed)
    prints = strewn(lens, count, rng, look, length_m=length_m)
    glare, shade = np.zeros((lens.height, lens.width)), np.ones((lens.height, lens.width))
    for one in prints:
        more, remains = light(lens, one, rng)
        glare, shade = glare + more, shade * remains
    picture = draw(lens, prints, replace(look, glare=glare, shade=shade))
    return jpeg(picture), {one.id: corners_px(lens, one) for one in prints}


def marker_in_glare() -> Picture:
    """Return a frame of marker 5 with glare over most of its cells."""
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=0.4)
    x, y = _pixels(VGA)
    return draw(VGA, [one], Look(glare=400 * np.exp(-((x - 340) ** 2 + (y - 250) ** 2) / (2 * 9.0**2))))


def spots(level: float, breadth: float, where: str) -> Light:
    """Return glare in round spots, ``breadth`` sides wide (sigma), on a random edge or corner."""

    def light(lens: CameraCalibration, one: Print, rng: np.random.Generator) -> tuple[Array, float]:
        k = int(rng.integers(4))
        start, end, after = _CORNERS[k], _CORNERS[(k + 1) % 4], _CORNERS[(k + 2) % 4]
        along = start + (end - start) * rng.uniform(0.25, 0.75)
        places = {
            "edge": [along],
            "corner": [start],
            "opposite edges": [along, -along],
            "adjacent edges": [along, end + (after - end) * rng.uniform(0.25, 0.75)],
            "inside": [rng.uniform(-0.3, 0.3, 2)],
        }[where]
        x, y = _pixels(lens)
        sigma_px = breadth * _side_px(lens, one)
        centres = [_seen(lens, one, place) for place in places]
        spread = [np.exp(-((x - c[0]) ** 2 + (y - c[1]) ** 2) / (2 * sigma_px**2)) for c in centres]
        return level * np.sum(spread, axis=0), 1.0

    return light


def streak(level: float, breadth: float, outside: float = 0.0) -> Light:
    """Return glare along a whole side, as of a tube lamp, or at a given distance from the side."""

    def light(lens: CameraCalibration, one: Print, rng: np.random.Generator) -> tuple[Array, float]:
        k = int(rng.integers(4))
        start, end = _CORNERS[k], _CORNERS[(k + 1) % 4]
        aside = (start + end) * outside
        ends = _seen(lens, one, start + aside), _seen(lens, one, end + aside)
        x, y = _pixels(lens)
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        middle = (ends[0] + ends[1]) / 2
        a = (x - middle[0]) * along[0] + (y - middle[1]) * along[1]
        b = (y - middle[1]) * along[0] - (x - middle[0]) * along[1]
        beyond = np.maximum(np.abs(a) - 0.6 * np.linalg.norm(ends[1] - ends[0]), 0.0)
        sigma_px = breadth * _side_px(lens, one)
        return level * np.exp(-(b**2 + beyond**2) / (2 * sigma_px**2)), 1.0

    return light


def shadow(remains: float) -> Light:
    """Return a hard shadow over a part of the print."""

    def light(lens: CameraCalibration, one: Print, rng: np.random.Generator) -> tuple[float, Array]:
        place, angle = _seen(lens, one, rng.uniform(-0.4, 0.4, 2)), rng.uniform(0, 2 * np.pi)
        middle = _seen(lens, one, np.zeros(2))
        x, y = _pixels(lens)
        behind = (x - place[0]) * np.cos(angle) + (y - place[1]) * np.sin(angle)
        near = np.hypot(x - middle[0], y - middle[1]) < 1.3 * _side_px(lens, one)
        dark = remains + (1 - remains) * np.exp(-np.maximum(behind, 0.0))
        return 0.0, np.where(near & (behind > 0), dark, 1.0)

    return light


def _pixels(lens: CameraCalibration) -> tuple[Array, Array]:
    y, x = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    return x, y


def _seen(lens: CameraCalibration, one: Print, place: Sequence[float] | Array) -> Array:
    """Return the image point of a point of a print; the input is in sides from its centre."""
    point_m = np.array([[place[0], place[1], 0.0]]) * one.length_m
    return np.asarray(_project(lens, point_m @ one.axes.T + one.centre_m)[0])


def _side_px(lens: CameraCalibration, one: Print) -> float:
    outline_px = corners_px(lens, one)
    return float(np.linalg.norm(np.roll(outline_px, -1, axis=0) - outline_px, axis=1).mean())


@dataclass(frozen=True)
class Scene:
    """A lighting, and its allowed corner error in px (RMS)."""

    light: Light
    rms_px: float = 0.1


LIGHTS: dict[str, Scene] = {
    **{
        f"{name} glare, {where}": Scene(spots(level, breadth, where))
        for name, level, breadth in (("soft", 90.0, 0.2), ("strong", 300.0, 0.1))
        for where in ("edge", "corner", "opposite edges", "adjacent edges", "inside")
    },
    "soft glare along a side": Scene(streak(90.0, 0.1)),
    "strong glare along a side": Scene(streak(300.0, 0.04)),
    "strong glare on the margin": Scene(streak(300.0, 0.06, outside=0.1)),
    "shadow of 60 %": Scene(shadow(0.6)),
    "shadow of 35 %": Scene(shadow(0.35)),
}
