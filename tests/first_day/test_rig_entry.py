"""Typed fields of a rig, and changes of the text of a rig file."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.app.first_day.camera_choice import list_options, save_cameras, set_calibration
from ipsys_log.app.first_day.rig_entry import (
    check_rig_entry,
    example_rig,
    replace_tables,
    replace_values,
    rig_fields,
    rig_warnings,
    save_rig_entry,
    write_rig,
)
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Floor, Rig, RigCamera, RigMarker
from ipsys_log.messages.rig_file import example_toml, load_rig, rig_toml

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
    ("marker_height_m", "10", "0.1 if it is in cm"),
    ("height_0", "12", "0.12 if it is in cm"),
    ("point_marker", "0", "this marker is on a robot"),
    ("ab_m", "2.1", "the coordinates of A and B give 2.438 m"),
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


def test_reference_points_that_give_poor_positions_are_warned_of() -> None:
    (missing,) = rig_warnings(example_rig())
    assert "height of the robots' markers is missing" in missing
    example = replace(example_rig(), marker_height_m=0.1)
    assert rig_warnings(example) == []
    rig, _ = check_rig_entry({"second_x_m": "1.3"}, example)
    assert rig is not None
    (warning,) = rig_warnings(rig)
    assert "0.08 m apart" in warning
    rig, _ = check_rig_entry({"second_x_m": "9"}, example)
    assert rig is not None
    assert rig_warnings(rig) == ["reference point B is outside the floor"]


def test_saved_fields_are_read_again(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    typed = {"name": 'a "hall"', "marker_length_m": "0.15", "robots": "3, 7", "second_x_m": "2.5"}
    typed |= {"marker_height_m": "0.1", "height_7": "0.25", "point_marker": "12"}
    assert save_rig_entry(path, {**typed, "second_x_m": "2,5"}) == []
    rig = load_rig(path)
    assert (rig.name, rig.marker_length_m) == ('a "hall"', 0.15)
    markers = [(marker.id, marker.robot, rig.height_of(marker.id)) for marker in rig.markers]
    assert markers == [(3, "robot_3", 0.1), (7, "robot_7", 0.25), (12, None, 0.0)]
    assert {**rig_fields(rig), **typed} == rig_fields(rig)
    # The tape moves B along the line from A; an empty height is no value.
    assert save_rig_entry(path, {"second_y_m": "3.6", "ab_m": "1.75", "marker_height_m": ""}) == []
    rig, (a, b) = load_rig(path), load_rig(path).reference_points
    assert np.hypot(b.x_m - a.x_m, b.y_m - a.y_m) == pytest.approx(1.75, abs=1e-4)
    assert (b.y_m - a.y_m) / (b.x_m - a.x_m) == pytest.approx(1.1616 / 1.2808, rel=1e-3)
    assert (rig.marker_height_m, rig.height_of(7)) == (None, 0.25)
    # A field that a page does not send keeps its value.
    assert save_rig_entry(path, {"name": "b"}) == []
    assert load_rig(path).reference_points == rig.reference_points


def test_robots_keep_their_names_and_other_markers_stay(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    assert save_rig_entry(path, {}) == []
    path.write_text(
        f'{path.read_text()}\n[[markers]]\nid = 5\nrobot = "ada"\n\n[[markers]]\nid = 8\nheight_m = 0.1\n'
    )
    assert save_rig_entry(path, {"robots": "5 6"}) == []
    markers = [(one.id, one.robot, one.height_m) for one in load_rig(path).markers]
    assert markers == [(5, "ada", None), (6, "robot_6", None), (9, None, 0.0), (8, None, 0.1)]
    # Without robots, all ids count: the marker for points would be the only one.
    assert save_rig_entry(path, {"robots": "", "point_marker": "9"}) == []
    assert [one.id for one in load_rig(path).markers] == [9, 8]
    path.unlink()
    assert save_rig_entry(path, {"robots": ""}) == []
    assert load_rig(path).markers == ()


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


CAMERAS = (RigCamera("red", source="usb:/dev/video0", width=1920), RigCamera("left", source="sim:black"))


def comments(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("# ") and " = " not in line]


def read(folder: Path, text: str) -> Rig:
    path = folder / "read.toml"
    path.write_text(text)
    return load_rig(path)


def test_changed_example_keeps_comments_between_tables(tmp_path: Path) -> None:
    old = example_toml()
    text = replace_tables(replace_values(old, {"name": "hall"}), "[[cameras]]", CAMERAS)
    text = replace_tables(text, "[floor]", [Floor(3.0, 2.5)])
    assert comments(text) == comments(old)
    rig = read(tmp_path, old)
    assert read(tmp_path, text) == replace(rig, name="hall", cameras=CAMERAS, floor=Floor(3.0, 2.5))


def test_missing_tables_are_added_at_the_end(tmp_path: Path) -> None:
    text = 'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
    assert read(tmp_path, replace_tables(text, "[[cameras]]", CAMERAS)).cameras == CAMERAS


def test_unknown_layout_is_refused_and_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    text = (
        'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
        'cameras = [{ name = "red", source = "sim:red" }]\n'
    )
    path.write_text(text)
    expected = replace(load_rig(path), cameras=CAMERAS)
    with pytest.raises(IpsysError, match=r"lab\.toml"):
        write_rig(path, replace_tables(text, "[[cameras]]", CAMERAS), expected)
    assert path.read_text() == text


def test_text_that_means_another_rig_is_refused(tmp_path: Path) -> None:
    """A name in dotted or quoted form stays, so the changed text would not mean the typed name."""
    path = tmp_path / "lab.toml"
    text = '"name" = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
    path.write_text(text)
    with pytest.raises(IpsysError, match="its layout is unusual"):
        write_rig(path, text, replace(load_rig(path), name="hall"))
    assert path.read_text() == text


names = st.text("abcdefgh_0123456789", max_size=8).map(lambda text: f"c{text}")
cameras = st.lists(
    st.builds(
        RigCamera, names, row_time_ns=st.none() | st.integers(1000, 10**6), width=st.none() | st.just(640)
    ),
    unique_by=lambda camera: camera.name,
    max_size=4,
).map(tuple)


@given(cameras, cameras, st.text(min_size=1, max_size=20).filter(lambda text: text.isprintable()))
def test_replaced_parts_are_those_of_the_new_rig(
    old: tuple[RigCamera, ...], new: tuple[RigCamera, ...], name: str
) -> None:
    import tomllib

    rig = Rig("lab", "DICT_4X4_100", 0.2, markers=(RigMarker(1, robot="ada"),), cameras=old)
    text = replace_tables(replace_values(rig_toml(rig), {"name": name}), "[[cameras]]", new)
    wanted = rig_toml(replace(rig, name=name, cameras=new))
    assert tomllib.loads(text) == tomllib.loads(wanted)
