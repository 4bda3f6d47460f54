"""Names that -o refuses before any work is done and before any camera is opened."""

from pathlib import Path

import pytest

from tests.conftest import Ipsys

RIG = """
name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
reference_points = [ { name = "A", x_m = 0.0, y_m = 0.0 }, { name = "B", x_m = 1.0, y_m = 0.0 } ]
[[markers]]
id = 1
[[cameras]]
name = "red"
source = "http://127.0.0.1:9/nobody"
calibration = "red.yaml"
"""


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    from tests.test_record import lens_yaml

    (tmp_path / "red.yaml").write_text(lens_yaml(640, 480) + "distortion_model: equidistant\n")
    path = tmp_path / "lab.toml"
    path.write_text(RIG)
    return path


@pytest.mark.parametrize(
    "command",
    [
        ("record", "--rig", "RIG"),
        ("measure", "--rig", "RIG"),
        ("align", "--rig", "RIG"),
        ("simulate",),
        ("replay", "LOG"),
        ("report", "LOG"),
    ],
    ids=lambda command: command[0],
)
def test_link_to_nowhere_is_refused_at_once(
    ipsys: Ipsys, lab: Path, rig: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:

    link = tmp_path / "link.mcap"
    link.symlink_to(tmp_path / "gone" / "away.mcap")
    before = sorted(tmp_path.iterdir())
    known = {"RIG": rig, "LOG": lab}
    done = ipsys(*(known.get(word, word) for word in command), "-o", link)
    assert done.code == 1
    assert done.err.count("\n") == 1, done.err
    assert f"is a link to {tmp_path}/gone/away.mcap, which does not exist" in done.err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("option", ["--html", "-o"])
def test_report_tells_the_page_from_a_log(ipsys: Ipsys, lab: Path, tmp_path: Path, option: str) -> None:
    link = tmp_path / "page.html"
    link.symlink_to("gone.html")
    done = ipsys("report", lab, option, link)
    assert done.code == 1
    if option == "-o":
        assert "the name of a new log ends in .mcap; ipsys report --html" in done.err
    else:
        assert "is a link to gone.html, which does not exist" in done.err
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.parametrize("name", ["next.png", "table.csv", "lab.TOML"])
def test_name_of_another_file_is_no_log(ipsys: Ipsys, lab: Path, tmp_path: Path, name: str) -> None:
    done = ipsys("replay", lab, "-o", tmp_path / name)
    assert done.code == 1
    assert f"-o {tmp_path / name}: the name of a new log ends in .mcap" in done.err
    assert not (tmp_path / f"{name}.mcap").exists()
