"""The check of one point: its position, and its faults."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.checks import EntryCheck, check_entry, next_id, withdrawal_of
from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry
from ipsys_log.live_runs.survey.scene import MarkerObservations
from ipsys_log.messages import Interval, Measurement, Model, ReferencePoint, Rig
from ipsys_log.statistics.camera_models import fit_model
from tests import labs

Array = labs.Array

RIG = replace(labs.RIG, tape_sigma_m=0.003)
THREE = replace(RIG, reference_points=(*RIG.reference_points, ReferencePoint("C", 2.0, 0.3)))
STILL = Interval(1_000, 2_000)
# points on the floor, at tape crossings of 15 degrees or more
PLACES = st.tuples(st.floats(0.1, 4.7), st.floats(0.1, 4.7), st.floats(0.0, 0.3)).filter(
    lambda p: abs(p[1] - labs.A[1]) > 0.5
)


def tape(world_m: Sequence[float], rig: Rig = RIG, **changed: Any) -> TypedEntry:
    """Return a point with correct readings, to the millimetre."""
    distances = {
        p.name: f"{100 * np.hypot(world_m[0] - p.x_m, world_m[1] - p.y_m):.1f}" for p in rig.reference_points
    }
    side = "" if len(distances) > 2 else "left" if world_m[1] > labs.A[1] else "right"
    return replace(TypedEntry("0", distances, side, f"{100 * world_m[2]:.1f}"), **changed)


def check(
    typed: TypedEntry,
    rig: Rig = RIG,
    history: Sequence[Measurement] = (),
    model: Model | None = None,
    seen: Mapping[str, Array] | None = None,
) -> EntryCheck:
    points_m = {"red": np.array([0.0, 0.0, 2.0])} if seen is None else seen
    sight = MarkerObservations(0, STILL if points_m else None, points_m)
    return check_entry(*parse_entry(typed, rig), rig, sight, history, model)


@given(PLACES)
def test_checked_point_equals_the_measured_point(world_m: tuple[float, float, float]) -> None:
    checked = check(tape(world_m))
    assert checked.faults == ()
    assert checked.point_m is not None
    assert checked.sigma_m is not None
    # Readings are to half a millimetre; flat circles amplify this, and report it.
    assert np.linalg.norm(checked.point_m - world_m) < 0.002 + 0.6 * checked.sigma_m
    assert checked.on_floor is True
    assert checked.measurement is not None
    assert checked.measurement.still == STILL
    assert STILL.start <= checked.measurement.timestamp <= STILL.end


@given(PLACES)
def test_three_distances_need_no_side_and_check_one_another(world_m: tuple[float, float, float]) -> None:
    good = check(tape(world_m, THREE), THREE)
    assert good.point_m is not None
    assert np.linalg.norm(good.point_m - world_m) < 0.005
    assert max(abs(off_m) for _, off_m in good.residuals_m) < 0.001
    read = tape(world_m, THREE)
    wrong = replace(read, distances={**read.distances, "C": f"{float(read.distances['C']) + 30:.1f}"})
    said = check(wrong, THREE)
    assert any("contradict each other" in text for text in said.warnings) or said.faults


def test_two_tapes_that_cannot_meet() -> None:
    checked = check(TypedEntry("0", {"A": "40", "B": "50"}, "left", "0"))
    assert checked.measurement is None
    said = "distance to A = 40 cm and distance to B = 50 cm do not meet, because A to B is 243.8 cm"
    assert checked.faults[0].text == f"{said}; read both again"
    # The fault is not the side, so it is reported before the question for the side.
    unsided = check(TypedEntry("0", {"A": "40", "B": "50"}, "", "0"))
    assert any("do not meet" in fault.text for fault in unsided.faults)
    # The height is not needed either.
    alone = check(TypedEntry("0", {"A": "40", "B": "50"}))
    assert any("do not meet" in fault.text for fault in alone.faults)


def test_missing_side_gives_both_points() -> None:
    checked = check(tape((1.0, 4.0, 0.0), side=""))
    assert checked.measurement is None
    places = dict(checked.sides_m)
    assert places["left"] == pytest.approx([1.0, 4.0, 0.0], abs=0.002)
    assert places["right"] == pytest.approx([1.0, 2 * labs.A[1] - 4.0, 0.0], abs=0.002)


def test_point_outside_the_floor_names_the_side_inside() -> None:
    narrow = replace(RIG, floor=replace(labs.RIG.floor, depth_m=3.0))  # type: ignore[type-var]
    checked = check(tape((1.0, 1.0, 0.0), side="left"), narrow)
    assert checked.on_floor is False
    assert "outside of the floor; with side right, it is on the floor" in checked.warnings[0]
    assert checked.measurement is not None


def test_tapes_that_cross_flatly() -> None:
    checked = check(tape((4.6, labs.A[1] + 0.2, 0.0)))
    assert any("the tapes cross at" in text for text in checked.warnings)


def test_a_marker_that_no_camera_sees_or_that_moves() -> None:
    unseen = check(tape((1.0, 4.0, 0.0)), seen={})
    assert unseen.measurement is None
    assert unseen.faults[0].text.startswith("no camera sees marker 0")
    assert unseen.point_m is not None
    moving = MarkerObservations(0, None, {}, ("red",))
    checked = check_entry(*parse_entry(tape((1.0, 4.0, 0.0)), RIG), RIG, moving, [])
    assert checked.faults[0].text == "marker 0 moves, as seen by red: wait until it stops"


def test_ids_count_up_and_undo_withdraws() -> None:
    first = check(tape((1.0, 4.0, 0.0))).measurement
    assert first is not None
    assert first.id == "p001"
    gone = withdrawal_of([first], "p001")
    assert (gone.withdraws, gone.timestamp) == ("p001", first.timestamp)
    assert next_id([first, gone]) == "p002"
    for history in ([first, gone], []):
        with pytest.raises(IpsysError, match="measurement p001 cannot be withdrawn"):
            withdrawal_of(history, "p001")
    assert check(tape((1.0, 4.0, 0.0), id="p001"), history=[first, gone]).faults[0].field == "id"


def test_repeated_point_gives_a_warning() -> None:
    first = check(tape((1.0, 4.0, 0.0))).measurement
    assert first is not None
    again = check(tape((1.0, 4.0, 0.0)), history=[first])
    assert "saved already as p001" in again.faults[0].text
    other = check(tape((1.0, 4.01, 0.0)), history=[first])
    assert len(other.warnings) == 1
    assert other.warnings[0].startswith("marker 0 is already measured here, as p001")
    assert check(tape((1.0, 4.0, 0.0)), history=[first, withdrawal_of([first], "p001")]).warnings == ()


@pytest.fixture(scope="module")
def known() -> tuple[labs.Camera, Model]:
    rng = np.random.default_rng(1)
    camera = labs.camera(rng, 1.0)
    world_m = labs.places(rng, 40, 1.0)
    measured_m, covariances = labs.measure(world_m, rng)
    return camera, fit_model(
        "best", {"red": labs.pairs(camera.see(world_m, rng), measured_m, covariances)}, 0
    )


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, None),
        ({"side": "left"}, "side right would fit, not left"),
        ({"distances": "swapped"}, "the distances to A and B look exchanged"),
        ({"distances": "A"}, "the distance to A reads"),
        ({"height": "65"}, "the height reads 65.0 cm; 10 cm would fit"),
    ],
)
def test_model_finds_the_gross_error(
    known: tuple[labs.Camera, Model], changed: dict[str, str], said: str | None
) -> None:
    camera, model = known
    place_m = np.array([1.7, 1.2, 0.1])
    seen = {"red": camera.see(place_m[None], np.random.default_rng(5))[0], "white": np.array([0.1, 0.1, 2.0])}
    read = tape(tuple(place_m))
    distances = {
        "swapped": {"A": read.distances["B"], "B": read.distances["A"]},
        "A": {**read.distances, "A": f"{float(read.distances['A']) + 40:.1f}"},
    }.get(changed.get("distances", ""), read.distances)
    texts = {name: text for name, text in changed.items() if name != "distances"}
    checked = check(replace(read, distances=distances, **texts), model=model, seen=seen)
    assert [one.camera for one in checked.predictions] == ["red"]
    if said is None:
        assert checked.warnings == ()
        assert checked.predictions[0].off_m < 0.02
    else:
        assert any(said in text for text in checked.warnings), checked.warnings
