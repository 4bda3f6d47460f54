"""Commands that take calibration files: assumed lens models, and files that only the rig names."""

import json
from pathlib import Path

import pytest

from ipsys_log.log.dataset import Session
from tests.conftest import Ipsys

CORNERS = ",".join(f"{axis}{corner}_px" for corner in range(4) for axis in "xy")
DETECTIONS = f"time,camera,marker_id,{CORNERS}\n2023-11-14T22:13:20Z,red,1,300,200,350,200,350,250,300,250\n"
LENS = """image_width: 640
image_height: 360
camera_matrix: [[380, 0, 320], [0, 380, 180], [0, 0, 1]]
distortion_coefficients: [0.01, 0, 0, 0]
"""
RIG = """name = "lab"
dictionary = "DICT_4X4_50"
marker_length_m = 0.1
[[cameras]]
name = "red"
width = 640
height = 360
source = "sim:red?stations=1"
calibration = "red.yaml"
"""
ASSUMED = "red.yaml does not state its lens model: its 4 coefficients are read as fisheye (k1 k2 k3 k4)"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a rig, the calibration file that it names, and detections."""
    (tmp_path / "lab.toml").write_text(RIG)
    (tmp_path / "red.yaml").write_text(LENS)
    (tmp_path / "a.csv").write_text(DETECTIONS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


IMPORT = ("import", "detections", "a.csv", "-o", "a.mcap", "--rig", "lab.toml")
RECORD = ("record", "--rig", "lab.toml", "-o", "a.mcap", "--seconds", "1")


@pytest.mark.parametrize(
    "command", [IMPORT, (*IMPORT, "--calibration", "red=red.yaml"), RECORD], ids=("rig", "option", "record")
)
def test_assumed_model_is_printed_recorded_and_shown(
    ipsys: Ipsys, folder: Path, command: tuple[str, ...]
) -> None:
    done = ipsys(*command)
    assert done.code == 0, done.err
    assert done.err.count(f"camera red: {ASSUMED}; state it in the file: distortion_model: ") == 1
    with Session([folder / "a.mcap"]) as log:
        assert log.assumed_models()["red"].startswith(ASSUMED)
    remarks = json.loads(ipsys("info", "a.mcap", "--json").out)["calibration_remarks"]
    assert [row["camera"] for row in remarks] == ["red"]
    assert "does not state its lens model" in ipsys("info", "a.mcap").out
    assert ASSUMED in ipsys("check", "a.mcap").out
    assert ASSUMED in ipsys("info", "a.mcap", "--json").out


@pytest.mark.parametrize("command", [IMPORT, RECORD], ids=("import", "record"))
def test_stated_model_causes_no_remark(ipsys: Ipsys, folder: Path, command: tuple[str, ...]) -> None:
    (folder / "red.yaml").write_text(f"{LENS}distortion_model: equidistant\n")
    done = ipsys(*command)
    assert done.code == 0, done.err
    assert "lens model" not in done.err + done.out
    assert json.loads(ipsys("info", "a.mcap", "--json").out)["calibration_remarks"] == []


def test_detections_use_the_calibration_that_the_rig_names(ipsys: Ipsys, folder: Path) -> None:
    assert ipsys(*IMPORT).code == 0
    with Session([folder / "a.mcap"]) as log:
        (lens,) = log.payloads([*log.calibrations.values()])
        assert (lens.width, lens.K[0, 0]) == (640, 380.0)
    assert ipsys("camera-frame", "a.mcap").code == 0


def test_detections_with_a_missing_calibration_name_the_file(ipsys: Ipsys, folder: Path) -> None:
    (folder / "red.yaml").unlink()
    done = ipsys(*IMPORT)
    assert done.code == 1
    assert "red.yaml: does not exist" in done.err
    assert not (folder / "a.mcap").exists()


def test_principal_point_of_a_crop_is_named(ipsys: Ipsys, folder: Path) -> None:
    (folder / "red.yaml").write_text(LENS.replace("320", "450") + "distortion_model: equidistant\n")
    said = "the principal point (450.0, 180.0) px is far from the centre of 640 x 360 px"
    done = ipsys(*IMPORT)
    assert done.code == 0
    assert f"camera red: {said}" in done.err
    assert "principal point (450.0" in ipsys("info", "a.mcap", "--json").out
    assert said in ipsys("check", "a.mcap").out
