"""Typed entries: mixed units, missing fields, and text that is not a number."""

from dataclasses import replace

import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.entry import TypedEntry, check_references, parse_entry
from ipsys_log.messages import ReferencePoint
from tests import labs

THREE = replace(labs.RIG, reference_points=(*labs.RIG.reference_points, ReferencePoint("C", 2.4, 0.1)))
GOOD = TypedEntry("0", {"A": "170.0", "B": "190.0"}, "left", "10")


def faults(typed: TypedEntry) -> dict[str, str]:
    return {fault.field: fault.text for fault in parse_entry(typed, labs.RIG)[1]}


def test_centimetres_become_metres_with_point_or_comma() -> None:
    entry, wrong = parse_entry(
        replace(GOOD, distances={"A": " 170.5", "B": "190,25cm"}, height="0"), labs.RIG
    )
    assert wrong == []
    assert [(d.reference, d.distance_m) for d in entry.distances] == [("A", 1.705), ("B", 1.9025)]
    assert (entry.marker_id, entry.side, entry.height_m) == (0, "left", 0.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1.234", "looks like metres; type 123.4"),
        ("1,9", None),  # a short distance, or metres to the decimetre: the page asks, and does not refuse
        ("1700", "if it is in mm, type 170"),
        ("99999", "is longer than the floor"),
        ("0", "above 0"),
        ("-5", "is not a number"),
        ("1e3", "is not a number"),
        ("nan", "is not a number"),
        ("170 m", "is not a number"),
        ("1.234,5", "is not a number"),
    ],
)
def test_a_distance_that_cannot_be_in_centimetres(text: str, said: str | None) -> None:
    typed = replace(GOOD, distances={"A": text, "B": "190.0"})
    if said is None:
        entry, wrong = parse_entry(typed, labs.RIG)
        assert wrong == []
        assert "if it is in metres, type 190" in entry.doubts[0]
    else:
        assert said in faults(typed)["d_A"]


@pytest.mark.parametrize("text", ["0", "0.0", "0,0 cm"])
def test_a_marker_on_a_reference_point_needs_no_tape(text: str) -> None:
    typed = TypedEntry("0", {"A": "", "B": text}, "", "0")
    entry, wrong = parse_entry(typed, labs.RIG)
    assert wrong == []
    assert [(d.reference, d.distance_m) for d in entry.distances] == [("B", 0.0)]
    assert set(faults(replace(typed, distances={"A": "", "B": "120"}, side="left"))) == {"d_A"}


@pytest.mark.parametrize("text", ["0,1", "0.5", "0.9 cm"])
def test_a_height_that_may_be_in_metres_is_asked_for(text: str) -> None:
    entry, wrong = parse_entry(replace(GOOD, height=text), labs.RIG)
    assert wrong == []
    assert "if it is in metres, type" in entry.doubts[0]
    assert parse_entry(replace(GOOD, height="1"), labs.RIG)[0].doubts == ()


@pytest.mark.parametrize(
    ("text", "said"),
    [("0.15", "looks like metres; type 15"), ("1500", "if it is in mm, type 150"), ("", "height?")],
)
def test_a_height_that_cannot_be_in_centimetres(text: str, said: str) -> None:
    assert said in faults(replace(GOOD, height=text))["height"]


def test_missing_entries_are_named() -> None:
    assert set(faults(TypedEntry("", {}))) == {"marker", "d_A", "d_B", "height"}
    assert set(faults(replace(GOOD, side=""))) == {"side"}
    assert "from A to B" in faults(replace(GOOD, side=""))["side"]


def test_a_marker_that_the_rig_does_not_know() -> None:
    assert faults(replace(GOOD, marker="7"))["marker"] == "marker 7 is not in the rig (it has 0)"


def test_two_of_three_references_need_no_side_unless_collinear() -> None:
    assert parse_entry(replace(GOOD, distances={"A": "170", "B": "190", "C": "300"}, side=""), THREE)[1] == []
    two = replace(GOOD, distances={"A": "170", "B": "", "C": "300"}, side="")
    assert [fault.field for fault in parse_entry(two, THREE)[1]] == ["side"]
    one = replace(GOOD, distances={"A": "170", "B": "", "C": ""})
    assert "two distances or more" in parse_entry(one, THREE)[1][0].text


@pytest.mark.parametrize(
    ("count", "said"), [(0, "has no reference points"), (1, "only the reference point A")]
)
def test_a_rig_without_reference_points(count: int, said: str) -> None:
    rig = replace(labs.RIG, reference_points=labs.RIG.reference_points[:count])
    with pytest.raises(IpsysError, match=said):
        check_references(rig)
