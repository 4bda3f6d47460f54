"""Changes of a rig file keep its comments, and mean the changed rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.app.first_day.rig_entry import replace_tables, replace_values, write_rig
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Floor, Rig, RigCamera, RigMarker
from ipsys_log.messages.rig_file import example_toml, load_rig, rig_toml

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
    with pytest.raises(IpsysError, match="cannot change its layout"):
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
