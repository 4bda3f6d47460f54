"""The changes in the image that start a search, and those that do not."""

from __future__ import annotations

import numpy as np
import pytest

from ipsys_log.stages.detect.motion import ChangeDetector
from tests.stages.drawing import Array, Picture

WIDTH, HEIGHT, BREADTH_PX = 640, 480, 80.0
ALL = [slice(0, HEIGHT)]
FLOOR, THING = 150, 60


def floor() -> Picture:
    rng = np.random.default_rng(0)
    return rng.integers(FLOOR - 8, FLOOR + 8, (HEIGHT, WIDTH)).astype(np.uint8)


def square(x: float, y: float, size: float = BREADTH_PX) -> Array:
    """Return the corners of a marker with its centre at (x, y)."""
    half = size / 2
    return np.array([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]])


def put(picture: Picture, corners_px: Array, level: int = THING) -> Picture:
    """Return an image with an object at the position of a marker."""
    (left, top), (right, bottom) = corners_px.min(axis=0).astype(int), corners_px.max(axis=0).astype(int)
    with_it = picture.copy()
    with_it[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = level
    return with_it


@pytest.fixture
def watch() -> ChangeDetector:
    """Return a detector of changes that knows the empty floor."""
    watch = ChangeDetector()
    for _ in range(3):
        assert watch.find_change(floor(), ALL, [], BREADTH_PX) is None
    return watch


def covers(region: tuple[slice, slice] | None, corners_px: Array) -> bool:
    """Return True if a region contains the whole marker, in pixels."""
    if region is None:
        return False
    low = np.array([region[1].start, region[0].start])
    high = np.array([region[1].stop, region[0].stop])
    inside = np.clip(corners_px, 0, [WIDTH - 1, HEIGHT - 1])
    return bool((inside >= low).all() and (inside <= high).all())


@pytest.mark.parametrize("place", [(320, 240), (41, 41), (599, 41), (41, 439), (599, 439), (333, 222)])
def test_new_object_is_detected_at_its_position(watch: ChangeDetector, place: tuple[float, float]) -> None:
    there = square(*place)
    assert covers(watch.find_change(put(floor(), there), ALL, [], BREADTH_PX), there)


def test_known_markers_start_no_search(watch: ChangeDetector) -> None:
    there = square(300, 200)
    assert watch.find_change(put(floor(), there), ALL, [there], BREADTH_PX) is None


@pytest.mark.parametrize("step_px", [3, 20, 70])
def test_floor_that_a_marker_uncovers_is_no_alarm(step_px: int) -> None:
    """A marker moves across a floor that was never seen without it."""
    watch = ChangeDetector()
    for n in range(8):
        there = square(100 + step_px * n, 200)
        assert watch.find_change(put(floor(), there), ALL, [there], BREADTH_PX) is None


def test_floor_under_a_marker_that_is_taken_away_is_no_alarm() -> None:
    watch, there = ChangeDetector(), square(300, 200)
    for _ in range(5):
        assert watch.find_change(put(floor(), there), ALL, [there], BREADTH_PX) is None
    assert watch.find_change(floor(), ALL, [], BREADTH_PX) is None


def test_another_marker_beside_a_known_one_is_noticed(watch: ChangeDetector) -> None:
    known, other = square(200, 200), square(420, 240)
    watch.find_change(put(floor(), known), ALL, [known], BREADTH_PX)
    picture = put(put(floor(), known), other)
    assert covers(watch.find_change(picture, ALL, [known], BREADTH_PX), other)


@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_object_at_the_edge_counts_if_half_of_it_is_visible(watch: ChangeDetector, side: str) -> None:
    """A smaller part cannot be a marker yet, and a search in every frame would be useless."""
    little, enough = (
        square(
            *{
                "left": (seen_px - BREADTH_PX / 2, 240),
                "right": (WIDTH - seen_px + BREADTH_PX / 2, 240),
                "top": (320, seen_px - BREADTH_PX / 2),
                "bottom": (320, HEIGHT - seen_px + BREADTH_PX / 2),
            }[side]
        )
        for seen_px in (20, 56)
    )
    assert watch.find_change(put(floor(), little), ALL, [], BREADTH_PX) is None
    assert covers(watch.find_change(put(floor(), enough), ALL, [], BREADTH_PX), enough)


def test_unchanged_object_becomes_background(watch: ChangeDetector) -> None:
    """A chair is searched for some frames only."""
    picture = put(floor(), square(320, 240, 160))
    alarms = [watch.find_change(picture, ALL, [], BREADTH_PX) is not None for _ in range(30)]
    assert alarms[0]
    assert not any(alarms[15:])


def test_slow_changes_of_light_are_no_alarm(watch: ChangeDetector) -> None:
    for level in np.linspace(0, 60, 60).astype(int).tolist():
        assert watch.find_change(floor() - np.uint8(level), ALL, [], BREADTH_PX) is None


def test_undecoded_rows_start_no_search(watch: ChangeDetector) -> None:
    """They still contain an older frame."""
    there = square(320, 100)
    picture = put(floor(), there)
    assert watch.find_change(picture, [slice(200, HEIGHT)], [], BREADTH_PX) is None
    assert watch.find_change(picture, [], [], BREADTH_PX) is None
    assert covers(watch.find_change(picture, [slice(0, 40), slice(56, 160)], [], BREADTH_PX), there)


@pytest.mark.parametrize("size", [(240, 320), (8, 8), (1, 1), (9, 3000)])
def test_frames_of_another_size_begin_anew(watch: ChangeDetector, size: tuple[int, int]) -> None:
    for _ in range(2):
        other = np.full(size, 20, np.uint8)
        assert watch.find_change(other, [slice(0, size[0])], [square(5, 5)], BREADTH_PX) is None


def test_markers_outside_the_image_are_ignored(watch: ChangeDetector) -> None:
    for place in ((-500, -500), (5000, 100), (320, -60), (-39, 479)):
        assert watch.find_change(floor(), ALL, [square(*place)], BREADTH_PX) is None
    assert (
        watch.find_change(put(floor(), square(320, 240)), ALL, [square(-500, -500)], BREADTH_PX) is not None
    )
