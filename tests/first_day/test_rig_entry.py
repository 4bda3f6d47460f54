"""The typed rig: faults at their fields in the words of the rig file, and a file that means the fields."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ipsys_log.app.first_day.camera_choice import list_options, save_cameras, set_calibration
from ipsys_log.app.first_day.rig_entry import (
    check_rig_entry,
    example_rig,
    rig_fields,
    rig_warnings,
    save_rig_entry,
)
from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera
from ipsys_log.messages.rig_file import load_rig

FAULTS = [
    ("name", " ", "the field is empty"),
    ("dictionary", "DICT_5", "'DICT_5' of the rig is unknown to OpenCV"),
    ("marker_length_m", "20", "write 0.2 if it is in cm"),
    ("marker_length_m", "0,2,1", "is not a number"),
    ("marker_length_m", "-1", "must be above 0"),
    ("width_m", "488", "write 4.88 if it is in cm"),
    ("depth_m", "wide", "is not a number"),
    ("first_y_m", "1000", "is too large for m"),
    ("robots", "1, x", "marker id x is not a number"),
    ("robots", "0 100", "has only the ids 0 to 99"),
]


@pytest.mark.parametrize(("field", "text", "fault"), FAULTS)
def test_wrong_value_is_a_fault_of_its_field(field: str, text: str, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    (found,) = save_rig_entry(path, {field: text})
    assert found.field == field
    assert fault in found.text
    assert not re.search("lab.toml|_m = ", found.text)  # the field has a label
    assert not path.exists()


def test_several_wrong_values_are_faults_of_all_their_fields() -> None:
    rig, faults = check_rig_entry({"name": "", "width_m": "x", "robots": "0"}, example_rig())
    assert rig is None
    assert [fault.field for fault in faults] == ["name", "width_m"]
    # Faults of values together are named in the same answer.
    same = {"first_x_m": "1", "first_y_m": "2", "second_x_m": "1", "second_y_m": "2"}
    _, faults = check_rig_entry({**same, "marker_length_m": "20"}, example_rig())
    assert [fault.field for fault in faults] == ["marker_length_m", "second_x_m"]


def test_equal_reference_points_are_a_fault() -> None:
    same = {"first_x_m": "1", "first_y_m": "2", "second_x_m": "1", "second_y_m": "2"}
    _, (fault,) = check_rig_entry(same, example_rig())
    assert (fault.field, "two reference points are at" in fault.text) == ("second_x_m", True)


def test_reference_points_that_give_poor_positions_are_warned_of() -> None:
    assert rig_warnings(example_rig()) == []
    rig, _ = check_rig_entry({"second_x_m": "1.3"}, example_rig())
    assert rig is not None
    (warning,) = rig_warnings(rig)
    assert "0.08 m apart" in warning
    rig, _ = check_rig_entry({"second_x_m": "9"}, example_rig())
    assert rig is not None
    assert rig_warnings(rig) == ["reference point B is outside the floor"]


def test_saved_fields_are_read_again(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    typed = {"name": 'a "hall"', "marker_length_m": "0.15", "robots": "3, 7", "second_x_m": "2.5"}
    assert save_rig_entry(path, {**typed, "second_x_m": "2,5"}) == []
    rig = load_rig(path)
    assert (rig.name, rig.marker_length_m) == ('a "hall"', 0.15)
    assert [(marker.id, marker.robot) for marker in rig.markers] == [(3, "robot_3"), (7, "robot_7")]
    assert {**rig_fields(rig), **typed} == rig_fields(rig)
    # A field that a page does not send keeps its value.
    assert save_rig_entry(path, {"name": "b"}) == []
    assert load_rig(path).reference_points == rig.reference_points


def test_robots_keep_their_names_and_other_markers_stay(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    assert save_rig_entry(path, {}) == []
    path.write_text(
        f'{path.read_text()}\n[[markers]]\nid = 5\nrobot = "ada"\n\n[[markers]]\nid = 9\nheight_m = 0.1\n'
    )
    assert save_rig_entry(path, {"robots": "5 6"}) == []
    markers = [(one.id, one.robot, one.height_m) for one in load_rig(path).markers]
    assert markers == [(5, "ada", None), (6, "robot_6", None), (9, None, 0.1)]


def test_named_cameras_are_written_with_their_settings(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    assert save_rig_entry(path, {}) == []
    assert save_cameras(path, {"sim:red": "red", "sim:white": "", "sim:black": "left"}, []) == []
    assert load_rig(path).cameras == (
        RigCamera("red", source="sim:red"),
        RigCamera("left", source="sim:black"),
    )
    set_calibration(path, "red", "red.yaml")
    assert save_cameras(path, {"sim:red": "right", "sim:white": "mid", "sim:black": ""}, []) == []
    renamed, added = load_rig(path).cameras
    assert (renamed.name, renamed.calibration, added) == (
        "right",
        "red.yaml",
        RigCamera("mid", source="sim:white"),
    )


@pytest.mark.parametrize(
    ("names", "fault"),
    [
        ({"sim:red": "Red"}, "must be small letters"),
        ({"sim:red": "../red"}, "must be small letters"),
        ({"sim:red": "a", "sim:black": "a"}, "two cameras have the name 'a'"),
    ],
)
def test_wrong_camera_name_is_a_fault_of_its_camera(
    names: dict[str, str], fault: str, tmp_path: Path
) -> None:
    path = tmp_path / "lab.toml"
    assert save_rig_entry(path, {}) == []
    before = path.read_text()
    (found,) = save_cameras(path, names, [])
    assert fault in found.text
    assert found.field in names
    assert path.read_text() == before


@pytest.mark.parametrize(
    ("names", "error"),
    [({"file:/etc/passwd": "red"}, "not attached any more"), ({"sim:red": ""}, "no camera has a name")],
)
def test_cameras_that_were_not_offered_are_refused(names: dict[str, str], error: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    assert save_rig_entry(path, {}) == []
    with pytest.raises(IpsysError, match=error):
        save_cameras(path, names, [])


def test_offered_cameras_hide_passwords() -> None:
    from dataclasses import replace

    rig = replace(example_rig(), cameras=(RigCamera("door", source="rtsp://admin:secret@10.0.0.7/live"),))
    assert next(option.key for option in list_options(rig, [])) == "rtsp://admin:***@10.0.0.7/live"
