"""The map beside the cameras in a video: robots, predictions, trails and reference points at their pixels."""

import colorsys
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from ipsys_log.app.report.styles import camera_styles, to_rgb
from ipsys_log.capture.simulation.settings import grid_names
from ipsys_log.messages import Floor, ReferencePoint, Rig, Track, Tracks
from ipsys_log.sinks.colours import camera_colours, oklab, robot_colour
from ipsys_log.sinks.video.floor_map import FloorMap, Scene

S = 1_000_000_000
RED, BLUE = (250, 20, 20), (20, 20, 250)
RIG = Rig(
    "lab", "DICT_4X4_100", 0.2, reference_points=(ReferencePoint("A", 3.0, 1.0),), floor=Floor(4.0, 4.0)
)
SCENE = Scene((), {"ada": RED, "bob": BLUE}, RIG, np.zeros(2), np.full(2, 4.0), 1, S, "poly")
SIZE_PX, FONT_PX = (600, 600), 14
ADA = Track("ada", 0, 1.0, 1.0, 0.0, 0.0)


def colour_at(drawn: FloorMap, picture: np.ndarray, x_m: float, y_m: float) -> tuple[int, ...]:
    """Return red, green and blue of the map at a point of the floor."""
    x_px, y_px = np.round(drawn.to_px(np.array([[x_m, y_m]]))[0]).astype(int)
    return tuple(picture[y_px, x_px, ::-1].tolist())


def is_red(colour: tuple[int, ...]) -> bool:
    return colour[0] > colour[2] + 60


@pytest.fixture
def floor_map() -> FloorMap:
    return FloorMap(SCENE, SIZE_PX, FONT_PX)


def test_robot_has_a_disc_and_an_arrow_ahead(floor_map: FloorMap) -> None:
    floor_map.add(Tracks(S, (ADA,)), S)
    picture = floor_map.draw(S)
    assert colour_at(floor_map, picture, 1.0, 1.0) == RED
    assert is_red(colour_at(floor_map, picture, 1.12, 1.0))
    assert not is_red(colour_at(floor_map, picture, 0.8, 1.0))


def test_robot_without_heading_has_no_arrow(floor_map: FloorMap) -> None:
    floor_map.add(Tracks(S, (replace(ADA, heading_rad=None),)), S)
    picture = floor_map.draw(S)
    assert colour_at(floor_map, picture, 1.0, 1.0) == RED
    assert not is_red(colour_at(floor_map, picture, 1.2, 1.0))


def test_prediction_is_a_ring_without_a_trail(floor_map: FloorMap) -> None:
    for step in range(3):
        at = replace(ADA, x_m=1.0 + step, heading_rad=None, coasting_ns=S // 10)
        floor_map.add(Tracks((step + 1) * S // 2, (at,)), (step + 1) * S // 2)
    picture = floor_map.draw(3 * S // 2)
    assert not is_red(colour_at(floor_map, picture, 3.0, 1.0))
    assert not is_red(colour_at(floor_map, picture, 1.5, 1.0))


def test_trail_has_a_gap_where_the_robot_was_not_seen(floor_map: FloorMap) -> None:
    """Half a second between the first two sightings, and 3 s before the last one."""
    for time_ns, x_m in ((S, 0.5), (3 * S // 2, 1.5), (9 * S // 2, 3.5)):
        floor_map.add(Tracks(time_ns, (replace(ADA, x_m=x_m, heading_rad=None),)), time_ns)
    picture = floor_map.draw(9 * S // 2)
    assert is_red(colour_at(floor_map, picture, 1.0, 1.0))
    assert not is_red(colour_at(floor_map, picture, 2.5, 1.0))
    assert colour_at(floor_map, picture, 3.5, 1.0) == RED


def test_robot_disappears_when_its_pose_is_old(floor_map: FloorMap) -> None:
    floor_map.add(Tracks(S, (ADA,)), S)
    assert not is_red(colour_at(floor_map, floor_map.draw(3 * S), 1.0, 1.0))
    assert np.array_equal(floor_map.draw(60 * S), FloorMap(SCENE, SIZE_PX, FONT_PX).draw(60 * S))


def test_unknown_robots_and_damaged_poses_are_not_drawn(floor_map: FloorMap) -> None:
    floor_map.add(Tracks(S, (replace(ADA, robot="eve"), replace(ADA, x_m=float("nan")))), S)
    assert np.array_equal(floor_map.draw(S), FloorMap(SCENE, SIZE_PX, FONT_PX).draw(S))


def test_reference_point_is_a_cross_at_its_place(floor_map: FloorMap) -> None:
    picture = floor_map.draw(S)
    assert min(colour_at(floor_map, picture, 3.0, 1.0)) > 150
    bare = FloorMap(replace(SCENE, rig=None), SIZE_PX, FONT_PX)
    assert max(colour_at(bare, bare.draw(S), 3.0, 1.03)) < 80


def test_ellipse_has_the_semi_axes_of_its_covariance(floor_map: FloorMap) -> None:
    """The half axes of the 95 % region are 2.45 sigma: 0.49 m along x, 0.24 m along y."""
    floor_map.add(
        Tracks(
            S, (replace(ADA, x_m=2.0, y_m=2.0, heading_rad=None, covariance_m2=np.diag([0.04, 0.01, 0.01])),)
        ),
        S,
    )
    picture = floor_map.draw(S)
    assert is_red(colour_at(floor_map, picture, 2.47, 2.0))
    assert not is_red(colour_at(floor_map, picture, 2.53, 2.0))
    assert is_red(colour_at(floor_map, picture, 2.0, 2.22))
    assert not is_red(colour_at(floor_map, picture, 2.0, 2.28))


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
