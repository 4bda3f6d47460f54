"""The effect of each gross error on a calibration point, as text and as a corrected measurement."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ipsys_log.messages import Distance, Measurement, ReferencePoint, Rig, WorldPoint
from ipsys_log.statistics.outliers import Blunder, possible_blunders
from ipsys_log.statistics.tape import world_point

POINTS = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0), ReferencePoint("C", 1.0, 3.0))
RIG = Rig("lab", "DICT_4X4_100", 0.2, reference_points=POINTS)
PLACE = Measurement(
    0, "a", marker_id=0, distances=(Distance("A", 1.5), Distance("B", 1.0)), side="left", height_m=0.1
)
TRUE = world_point(PLACE, RIG).world_m


def slips(measurement: Measurement, *, rig: Rig = RIG, predicted: object = TRUE) -> list[Blunder]:
    return [slip for group in possible_blunders(measurement, rig, np.array(predicted)) for slip in group]


def misread(index: int, distance_m: float) -> Measurement:
    distances = [*PLACE.distances]
    distances[index] = replace(distances[index], distance_m=distance_m)
    return replace(PLACE, distances=tuple(distances))


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (replace(PLACE, side="right"), "it lies left of the line from A to B, not right"),
        (misread(0, 1.6), "the distance to A reads 1.600 m; 1.50 m, 10 cm less, would fit"),
        (misread(0, 1.512), "the distance to A reads 1.512 m; 1.500 m, 1.2 cm less, would fit"),
        (misread(1, 0.9), "the distance to B reads 0.900 m; 1.00 m, 10 cm more, would fit"),
        (replace(PLACE, height_m=0.3), "the height reads 0.300 m; 0.10 m, 20 cm less, would fit"),
        (
            replace(PLACE, distances=(Distance("A", 1.0), Distance("B", 1.5))),
            "the distances to A and B look exchanged: 1.500 m to A and 1.000 m to B fit",
        ),
        (
            replace(PLACE, distances=(Distance("A", 1.0), Distance("B", 1.5)), side="right"),
            "the distances to A and B look exchanged: 1.500 m to A and 1.000 m to B fit, "
            "and it lies left of the line from A to B, not right",
        ),
    ],
)
def test_corrected_gross_error_gives_the_true_point(wrong: Measurement, text: str) -> None:
    (slip,) = [one for one in slips(wrong) if one.text == text]
    np.testing.assert_allclose(world_point(slip.corrected, RIG).world_m, TRUE, atol=1e-9)


@given(st.floats(-3, 5), st.floats(-4, 4), st.floats(-0.4, 0.4), st.sampled_from([0, 1]))
def test_corrected_distance_is_the_best_possible_one(x: float, y: float, off_m: float, which: int) -> None:
    assume(abs(y) > 0.3)
    predicted = np.array([x, y, 0.1])
    distances = [Distance(p.name, float(np.hypot(x - p.x_m, y - p.y_m))) for p in POINTS[:2]]
    assume(distances[which].distance_m + off_m > 0.1)
    distances[which] = replace(distances[which], distance_m=distances[which].distance_m + off_m)
    wrong = replace(PLACE, distances=tuple(distances), side="left" if y > 0 else "right")
    found = [slip for slip in slips(wrong, predicted=predicted) if slip.kind == "distance"][which]
    np.testing.assert_allclose(world_point(found.corrected, RIG).world_m, predicted, atol=1e-6)
    assert found.corrected.distances[1 - which] == distances[1 - which]


def test_models_are_ordered_by_complexity() -> None:
    groups = [[slip.kind for slip in group] for group in possible_blunders(PLACE, RIG, TRUE)]
    assert groups == [["side", "swapped"], ["swapped"], ["distance", "distance", "height"]]


def test_three_distances_determine_the_side() -> None:
    ranges = [Distance(p.name, float(np.hypot(*(TRUE[:2] - [p.x_m, p.y_m])))) for p in POINTS]
    wrong = replace(PLACE, distances=(ranges[0], ranges[1], replace(ranges[2], distance_m=2.3)), side=None)
    found = slips(wrong)
    kinds = [slip.kind for slip in found]
    assert kinds == ["swapped"] * 3 + ["distance"] * 3 + ["height"]
    assert [slip.kind for slip in slips(replace(wrong, side="right"))] == kinds
    by_c = found[5]
    assert "the distance to C reads 2.300 m" in by_c.text
    np.testing.assert_allclose(world_point(by_c.corrected, RIG).world_m, TRUE, atol=1e-9)


def test_repeated_reference_point_still_names_the_line() -> None:
    twice = replace(PLACE, distances=(Distance("A", 1.5), Distance("A", 1.5), Distance("B", 1.0)))
    sides = [slip.text for slip in slips(twice) if slip.kind == "side"]
    assert sides == ["it lies right of the line from A to B, not left"]
    # Without the distance to B, the side is unknown.
    assert "the distance to B" not in " ".join(slip.text for slip in slips(twice) if slip.kind == "distance")


def test_world_point_uses_the_first_two_reference_points() -> None:
    x, y, z = TRUE.tolist()
    given_point = Measurement(0, "a", marker_id=0, point=WorldPoint(x, -y, z))
    found = slips(given_point)
    np.testing.assert_allclose(world_point(found[0].corrected, RIG).world_m, TRUE, atol=1e-9)
    assert found[0].text == "it lies left of the line from A to B, not right"
    assert any(slip.text.startswith("the distance to A comes to 1.500 m;") for slip in found)
    alone = slips(given_point, rig=replace(RIG, reference_points=POINTS[:1]), predicted=[x, -y, z + 0.2])
    assert [slip.text for slip in alone] == ["the height reads 0.100 m; 0.30 m, 20 cm more, would fit"]
    np.testing.assert_allclose(world_point(alone[0].corrected, RIG).world_m, [x, -y, z + 0.2])


def test_a_point_that_came_with_distances_is_corrected_by_them() -> None:
    x, y, z = TRUE.tolist()
    both = replace(misread(0, 1.6), side=None, height_m=None, point=WorldPoint(x + 0.1, y, z))
    texts = [slip.text for slip in slips(both)]
    assert "the distance to A reads 1.600 m; 1.50 m, 10 cm less, would fit" in texts


def test_a_point_with_distances_from_one_reference_point_only() -> None:
    x, y, z = TRUE.tolist()
    odd = Measurement(
        0, "a", marker_id=0, distances=(Distance("A", 1.5), Distance("A", 1.5)), point=WorldPoint(x, y, z)
    )
    assert any(slip.text.startswith("the distance to B") for slip in slips(odd))


def test_marker_below_the_floor_is_refused() -> None:
    assert [slip for slip in slips(PLACE, predicted=[*TRUE[:2], -0.1]) if slip.kind == "height"] == []
    assert [slip for slip in slips(PLACE, predicted=[*TRUE[:2], -0.01]) if slip.kind == "height"] != []
