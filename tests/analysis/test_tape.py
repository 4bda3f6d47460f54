"""World points from tape and ruler, and their covariance."""

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Distance, Measurement, ReferencePoint, Rig, WorldPoint
from ipsys_log.statistics.tape import RiggedMeasurement, find_weak_points, reference_points, world_point

POINTS = (
    ReferencePoint("A", 1.2192, 2.4384),
    ReferencePoint("B", 3.6576, 2.4384),
    ReferencePoint("C", 2.4, 0.5),
)
RIG = Rig("lab", "DICT_4X4_100", 0.2, reference_points=POINTS, tape_sigma_m=0.003)
UNKNOWN = replace(RIG, tape_sigma_m=None)


def tape(*names: str, x: float = 2.0, y: float = 3.5, sigma_m: float | None = None) -> tuple[Distance, ...]:
    """Return the distances from (x, y)."""
    known = {point.name: point for point in POINTS}
    return tuple(
        Distance(name, float(np.hypot(x - known[name].x_m, y - known[name].y_m)), sigma_m) for name in names
    )


def measurement(*names: str, x: float = 2.0, y: float = 3.5, sigma_m: float | None = None) -> Measurement:
    distances = tape(*names, x=x, y=y, sigma_m=sigma_m)
    side = "left" if y >= 2.4384 else "right"
    return Measurement(0, "a", marker_id=0, distances=distances, side=side, height_m=0.1)


def test_covariance_uses_the_sigmas_of_the_measurement_first() -> None:
    named = world_point(measurement("A", "B", sigma_m=0.006), RIG).covariance_m2
    from_rig = world_point(measurement("A", "B"), RIG).covariance_m2
    assert named is not None
    assert from_rig is not None
    np.testing.assert_allclose(named[:2, :2], 4 * from_rig[:2, :2], rtol=1e-12)
    assert world_point(measurement("A", "B"), UNKNOWN).covariance_m2 is None
    # One of two distances has no sigma: no sigma is invented.
    half = (*tape("A", sigma_m=0.003), *tape("B"))
    assert world_point(replace(measurement("A", "B"), distances=half), UNKNOWN).covariance_m2 is None


def test_the_height_has_the_sigma_of_the_ruler() -> None:
    place = measurement("A", "B")
    for sigma_m, expected_m in ((None, 0.001), (0.004, 0.004)):
        covariance = world_point(replace(place, height_sigma_m=sigma_m), RIG).covariance_m2
        assert covariance is not None
        assert covariance[2].tolist() == [0.0, 0.0, pytest.approx(expected_m**2)]
        assert covariance[:, 2].tolist() == covariance[2].tolist()


def test_the_covariance_is_that_of_tapes_read_again_and_again() -> None:
    rng = np.random.default_rng(2)
    place = replace(measurement("A", "B", x=1.0, y=3.0, sigma_m=0.004), height_sigma_m=0.002)

    def read_again() -> Measurement:
        drawn = tuple(replace(d, distance_m=d.distance_m + rng.normal(0, 0.004)) for d in place.distances)
        return replace(place, distances=drawn, height_m=0.1 + rng.normal(0, 0.002))

    sample = np.cov(np.array([world_point(read_again(), RIG).world_m for _ in range(3000)]).T)
    expected = world_point(place, RIG).covariance_m2
    assert expected is not None
    root = np.linalg.inv(np.linalg.cholesky(expected))
    np.testing.assert_allclose(root @ sample @ root.T, np.eye(3), atol=0.12)


def test_world_point_with_distances_has_a_covariance() -> None:
    given_point = WorldPoint(2.0, 3.5, 0.1)
    alone = world_point(Measurement(0, "a", point=given_point), RIG)
    assert alone.world_m.tolist() == [2.0, 3.5, 0.1]
    assert alone.covariance_m2 is None
    assert alone.residuals_m.shape == (0,)
    solved = measurement("A", "B")
    both = world_point(replace(solved, point=given_point), RIG)
    wanted = world_point(solved, RIG).covariance_m2
    assert both.covariance_m2 is not None
    assert wanted is not None
    np.testing.assert_allclose(both.covariance_m2, wanted, rtol=1e-9)
    np.testing.assert_allclose(both.residuals_m, 0, atol=1e-12)
    # The measurement is a world point, so it does not depend on the rig.
    nowhere = world_point(replace(solved, point=given_point), replace(RIG, reference_points=()))
    assert nowhere.covariance_m2 is None
    assert nowhere.world_m.tolist() == [2.0, 3.5, 0.1]


def test_a_perfect_tape_is_still_a_tape() -> None:
    covariance = world_point(measurement("A", "B", sigma_m=0.0), RIG).covariance_m2
    assert covariance is not None
    assert 0 < np.sqrt(np.linalg.eigvalsh(covariance[:2, :2]).min()) < 0.001


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"distances": tape("A")}, "needs a world point, or two or more distances"),
        ({"height_m": None}, "needs a world point, or two or more distances"),
        ({"side": None}, "measurement a: .*give the side, 'left' or 'right'"),
        ({"side": "above"}, "measurement a: side 'above'"),
        ({"distances": (Distance("A", 1.0), Distance("Z", 1.0))}, "'Z' is not in the rig"),
        ({"distances": (Distance("A", 1.0), Distance("A", 1.1))}, "all its distances are from one"),
        ({"distances": (Distance("A", 0.5), Distance("B", 0.5))}, "measurement a: .* do not meet"),
        ({"distances": tape("A", "B", sigma_m=-0.1)}, "measurement a: -0.1 m is not a standard deviation"),
        ({"distances": tape("A", "B", sigma_m=float("nan"))}, "nan m is not a standard deviation"),
        ({"height_sigma_m": float("inf")}, "inf m is not a standard deviation"),
        ({"height_m": float("nan")}, "measurement a: its world point"),
        ({"point": WorldPoint(1.0, float("inf"), 0.0)}, "measurement a: its world point"),
    ],
)
def test_impossible_point_is_refused_by_name(change: dict[str, object], said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        world_point(replace(measurement("A", "B"), **change), RIG)  # type: ignore[arg-type]


def test_the_reference_points_of_the_distances_in_their_order() -> None:
    found = reference_points(measurement("C", "A"), RIG)
    assert found.tolist() == [[2.4, 0.5], [1.2192, 2.4384]]
    assert reference_points(Measurement(0, "a"), RIG).shape == (0, 2)


def test_flat_tape_crossings_are_listed_worst_first() -> None:
    here = {"good": (2.4, 3.6), "flat": (2.4, 2.65), "beyond": (4.6, 2.6), "flatter": (2.4, 2.5)}
    places = [
        RiggedMeasurement(replace(measurement("A", "B", x=x, y=y), id=name), RIG)
        for name, (x, y) in here.items()
    ]
    found = find_weak_points(places)
    assert [flat.id for flat in found] == ["flatter", "beyond", "flat"]
    for flat in found:
        x, y = here[flat.id]
        to_a, to_b = (np.arctan2(y - point.y_m, x - point.x_m) for point in POINTS[:2])
        angle = abs(np.sin(to_b - to_a))
        assert np.sin(np.radians(flat.angle_deg)) == pytest.approx(angle)
        # The closed form gives the worst direction of two equal tapes at an angle.
        assert flat.sigma_m == pytest.approx(0.003 / np.sqrt(1 - np.sqrt(1 - angle**2)))
    assert found[0].sigma_m is not None
    assert found[0].sigma_m > 3 * 0.003


def test_crossing_angle_counts_without_a_sigma() -> None:
    flat = RiggedMeasurement(measurement("A", "B", x=2.4, y=2.5), UNKNOWN)
    found = find_weak_points([flat])
    assert [(one.id, one.sigma_m) for one in found] == [("a", None)]
    # A third tape from another direction determines the point.
    assert find_weak_points([RiggedMeasurement(measurement("A", "B", "C", x=2.4, y=2.5), RIG)]) == []
    assert (
        find_weak_points([RiggedMeasurement(Measurement(0, "b", point=WorldPoint(2.4, 2.5, 0)), RIG)]) == []
    )


def test_marker_on_a_reference_point_has_its_position() -> None:
    rig = RIG
    b = rig.reference_points[1]
    on_b = Measurement(0, "b", marker_id=0, distances=(Distance(b.name, 0.0),), height_m=0.0)
    point = world_point(on_b, rig)
    np.testing.assert_array_equal(point.world_m, [b.x_m, b.y_m, 0.0])
    # A hand lays the marker to 1 mm; the sigma of the tape does not matter.
    assert point.covariance_m2 is not None
    np.testing.assert_allclose(np.sqrt(point.covariance_m2.diagonal()), 0.001)
    with pytest.raises(IpsysError, match="needs a world point, or two or more distances"):
        world_point(replace(on_b, distances=(Distance(b.name, 0.5),)), rig)
