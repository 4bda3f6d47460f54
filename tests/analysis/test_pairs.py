"""The valid calibration points, their positions, and their observations by a camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.imsel import read_imsel
from ipsys_log.messages import (
    CameraPoint,
    CameraPoints,
    Distance,
    Interval,
    Measurement,
    Message,
    ReferencePoint,
    Rig,
    RigMarker,
    WorldPoint,
)
from ipsys_log.statistics.calibration_points import (
    active_measurements,
    build_pairs,
    gather_sightings,
    split,
    still_interval,
    valid_measurements,
)
from ipsys_log.statistics.tape import RiggedMeasurement

S, MS = 1_000_000_000, 1_000_000
RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    markers=(RigMarker(0), RigMarker(1)),
    reference_points=(ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0)),
)


def seen(*rows: tuple[float, float, float], camera: str = "red", marker: int = 0) -> list[Message]:
    """Return messages of (time in s, x, z)."""
    return [
        Message(
            "t", int(t * S), int(t * S), CameraPoints(int(t * S), (CameraPoint(marker, x, 0.0, z),)), camera
        )
        for t, x, z in rows
    ]


def still(start: float, end: float, x: float, z: float = 2.0) -> list[tuple[float, float, float]]:
    return [(t, x + 0.001 * (-1) ** n, z) for n, t in enumerate(np.arange(start, end, 0.1))]


def test_stationary_interval_around_a_time_is_found() -> None:
    moving = [(t, 0.1 * t, 2.0) for t in np.arange(5, 10, 0.1)]
    rows = [*still(0, 5, 0.5), *moving, *still(10, 15, 1.0)]
    sightings = gather_sightings(seen(*rows))["red", 0]
    first, last = still_interval(sightings, 2 * S) or (0, 0)
    assert first == 0
    assert 4.8 * S < last < 5.3 * S
    first, last = still_interval(sightings, int(12.3 * S)) or (0, 0)
    assert 9.7 * S < first <= 10 * S
    assert last == pytest.approx(14.9 * S)


def late(*rows: tuple[int, int | None, float]) -> list[Message]:
    """Return messages of (frame time in s, time offset in ns, x)."""
    return [
        Message(
            "t", t * S, t * S, CameraPoints(t * S, (CameraPoint(0, x, 0.0, 2.0, None, offset_ns),)), "red"
        )
        for t, offset_ns, x in rows
    ]


def test_sighting_has_the_exposure_time_of_the_marker() -> None:
    sightings = gather_sightings(late((0, 30 * MS, 0.1), (1, None, 0.3), (1, -10 * MS, 0.2)))["red", 0]
    assert sightings.times_ns.tolist() == [0.03 * S, 0.99 * S, S]
    assert sightings.points_m[:, 0].tolist() == [0.1, 0.2, 0.3]


def test_a_still_interval_holds_for_what_was_exposed_in_it() -> None:
    sightings = gather_sightings(late((0, 30 * MS, 0.1), (1, 30 * MS, 0.2), (2, 30 * MS, 0.3)))
    given = Measurement(0, "a", marker_id=0, still=Interval(S, 2 * S), point=WorldPoint(1, 2, 3))
    (pair,) = build_pairs(sightings, [RiggedMeasurement(given, RIG)])["red"]
    assert (pair.frames, pair.camera_m[0]) == (1, 0.2)


def test_lifted_marker_ends_a_stationary_interval() -> None:
    sightings = gather_sightings(seen(*still(0, 2, 0.5), *still(2, 4, 0.5, z=1.95)))["red", 0]
    assert still_interval(sightings, S) == pytest.approx((0, 1.9 * S))


def test_long_gap_ends_a_stationary_interval() -> None:
    sightings = gather_sightings(seen(*still(0, 1, 0.5), *still(10, 11, 0.5)))["red", 0]
    assert still_interval(sightings, int(0.5 * S)) == pytest.approx((0, 0.9 * S))
    assert still_interval(sightings, 5 * S) is None


def test_a_pair_is_the_mean_over_the_still_interval() -> None:
    rows = still(0, 2, 0.5)
    given = Measurement(0, "a", marker_id=0, still=Interval(int(0.5 * S), S), point=WorldPoint(1, 2, 3))
    pair = build_pairs(gather_sightings(seen(*rows)), [RiggedMeasurement(given, RIG)])["red"][0]
    inside = [x for t, x, _ in rows if 0.5 <= t <= 1.0]
    assert pair.frames == len(inside) == 6
    assert pair.camera_m[0] == pytest.approx(np.mean(inside))
    np.testing.assert_array_equal(pair.world_m, [1, 2, 3])


def test_pair_contains_the_covariance_of_its_point() -> None:
    sightings = gather_sightings(seen(*still(0, 1, 0.5)))
    corner = (Distance("A", 2.0, 0.003), Distance("B", 2.0 * 2**0.5, 0.003))
    taped = Measurement(
        0, "a", marker_id=0, distances=corner, side="left", height_m=0.1, height_sigma_m=0.002
    )
    pair = build_pairs(sightings, [RiggedMeasurement(taped, RIG)])["red"][0]
    np.testing.assert_allclose(pair.world_m, [0, 2, 0.1], atol=1e-9)
    assert pair.world_covariance_m2 is not None
    # The tape from A gives y; the tape from B, at 45 degrees, adds x.
    sigmas_m = np.sqrt(pair.world_covariance_m2.diagonal())
    np.testing.assert_allclose(sigmas_m, [0.003 * 3**0.5, 0.003, 0.002], rtol=1e-9)
    given_point = Measurement(0, "b", marker_id=0, point=WorldPoint(1, 2, 0))
    assert build_pairs(sightings, [RiggedMeasurement(given_point, RIG)])["red"][0].world_covariance_m2 is None


def test_camera_has_no_pair_for_an_unseen_point() -> None:
    messages = seen(*still(0, 1, 0.5)) + seen(*still(50, 51, 0.5), camera="black")
    measured = Measurement(S // 2, "a", marker_id=0, point=WorldPoint(1, 2, 0))
    pairs = build_pairs(gather_sightings(messages), [RiggedMeasurement(measured, RIG)])
    assert len(pairs["red"]) == 1
    assert pairs["black"] == []


def test_a_withdrawn_measurement_does_not_count() -> None:
    one, two = (Measurement(0, name, marker_id=0, point=WorldPoint(0, 0, 0)) for name in "ab")
    assert active_measurements([one, two, Measurement(1, "c", withdraws="a")]) == [two]
    # The point may be measured again with its old name.
    assert active_measurements([one, Measurement(1, "c", withdraws="a"), one]) == [one]
    with pytest.raises(IpsysError, match="two measurements have the id 'a'"):
        active_measurements([one, one])


@pytest.mark.parametrize(
    ("measurement", "said"),
    [
        (Measurement(0, "a", marker_id=5, point=WorldPoint(0, 0, 0)), "marker 5, which is not in the rig"),
        (Measurement(0, "a", marker_id=1, point=WorldPoint(0, 0, 0)), "marker 1, which no camera saw"),
        (Measurement(0, "a", marker_id=0), "needs a world point, or two or more distances"),
        (
            Measurement(
                0,
                "a",
                marker_id=0,
                distances=(Distance("A", 1.0), Distance("Z", 1.0)),
                side="left",
                height_m=0.0,
            ),
            "'Z' is not in the rig",
        ),
        (
            Measurement(
                0,
                "a",
                marker_id=0,
                distances=(Distance("A", 0.5), Distance("B", 0.5)),
                side="left",
                height_m=0.0,
            ),
            "measurement a: .* do not meet",
        ),
    ],
)
def test_incomplete_measurements_are_refused(measurement: Measurement, said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        build_pairs(gather_sightings(seen(*still(0, 1, 0.5))), [RiggedMeasurement(measurement, RIG)])


def test_a_split_at_random_is_a_fifth_and_the_same_for_a_seed() -> None:
    measurements = [Measurement(0, f"m{n}") for n in range(50)]
    train, held_out = split(measurements, "train", seed=3)
    assert len(held_out) == 10
    assert train | held_out == {m.id for m in measurements}
    assert not train & held_out
    assert split(list(reversed(measurements)), "train", seed=3) == (train, held_out)
    assert split(measurements, "train", seed=4) != (train, held_out)


def test_measurement_uses_the_rig_of_its_time() -> None:
    moved = replace(RIG, reference_points=(ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 3.0, 0.0)))
    one, two = (Measurement(0, name, marker_id=0, point=WorldPoint(0, 0, 0)) for name in "ab")
    log = [Message("t", n, n, payload) for n, payload in enumerate((one, RIG, two, moved))]
    found = valid_measurements(log, None)
    assert [(place.measurement.id, place.rig) for place in found] == [("a", RIG), ("b", RIG)]
    assert [place.rig for place in valid_measurements(log, moved)] == [moved, moved]
    later = [*log, Message("t", 9, 9, Measurement(0, "c", marker_id=0))]
    assert valid_measurements(later, None)[-1].rig == moved


def test_held_out_points_are_never_used_by_fit() -> None:
    both = [Measurement(0, "a", splits=("train", "test")), Measurement(0, "b", splits=("test",))]
    assert split(both, "train", 0) == ({"a"}, {"b"})
    with pytest.raises(IpsysError, match="held out"):
        split(both, "test", 0)
    with pytest.raises(IpsysError, match="label some for the fit"):
        split(both[1:], "train", 0)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_invalid_world_point_is_refused(value: float) -> None:
    measurement = Measurement(0, "a", marker_id=0, point=WorldPoint(1.0, 2.0, value))
    with pytest.raises(IpsysError, match="measurement a: its world point"):
        build_pairs(gather_sightings(seen(*still(0, 1, 0.5))), [RiggedMeasurement(measurement, RIG)])


def test_points_of_two_cameras_have_one_name_in_the_paper_data(data: Path) -> None:
    log = list(read_imsel(data / "imsel"))
    pairs = build_pairs(gather_sightings(log), valid_measurements(log, None))
    names = {
        camera: {pair.calibration_point or pair.measurement for pair in found}
        for camera, found in pairs.items()
    }
    assert {camera: len(own) for camera, own in names.items()} == dict.fromkeys(("red", "white", "black"), 50)
    assert len(names["red"] & names["white"]) == len(names["white"] & names["black"]) == 5
    assert not names["red"] & names["black"]
    # The labels of the paper belong to a camera, so the measurements stay separate.
    assert len({pair.measurement for found in pairs.values() for pair in found}) == 150
