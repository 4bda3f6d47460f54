"""Written calibrations that other software reads."""

import copy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import (
    check_format,
    kalibr_yaml,
    opencv_yaml,
    read_intrinsics,
    ros_yaml,
)
from ipsys_log.messages import CameraCalibration
from ipsys_log.vision.lenses import same_intrinsics

COEFFICIENTS = {
    "kannala_brandt": (-0.1305, 0.0119, -0.0310, 1 / 3),
    "plumb_bob": (-0.33, 0.046, -0.0043, 0.0041, 1e-7),
    "rational_polynomial": (0.2, 0.05, 0.001, -0.002, 0.01, 0.3, 0.04, 0.002),
}


def lens(model: str) -> CameraCalibration:
    k = np.array([[1151.6 / 0.9, 0, 932.9], [0, 1148.8, 504.3], [0, 0, 1]])
    return CameraCalibration(0, "red", 1920, 1080, model, np.array(COEFFICIENTS[model]), k)


@pytest.mark.parametrize("model", list(COEFFICIENTS))
@pytest.mark.parametrize("write", [opencv_yaml, ros_yaml])
def test_written_calibration_reads_back_exactly(
    tmp_path: Path, model: str, write: Callable[..., str]
) -> None:
    path = tmp_path / "red.yaml"
    path.write_text(write(lens(model), {"fx": 1.5, "k1": 0.0}, "two\nlines"))
    assert same_intrinsics(read_intrinsics(path, "red"), lens(model))


def test_opencv_says_how_well_each_parameter_is_known() -> None:
    import cv2

    text = opencv_yaml(lens("plumb_bob"), {"fx": 1.5, "k3": 0.25}, "")
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    known = storage.getNode("standard_deviations")
    assert (known.getNode("fx").real(), known.getNode("k3").real()) == (1.5, 0.25)


@pytest.mark.parametrize(("model", "name"), [("kannala_brandt", "equidistant"), ("plumb_bob", "radtan")])
def test_kalibr(model: str, name: str) -> None:
    camera = YAML(typ="safe").load(kalibr_yaml(lens(model), {}, "comment"))["cam0"]
    assert camera["distortion_model"] == name
    assert camera["distortion_coeffs"] == list(COEFFICIENTS[model][:4])
    assert camera["intrinsics"] == [1151.6 / 0.9, 1148.8, 932.9, 504.3]
    assert camera["resolution"] == [1920, 1080]


# Focal lengths and principal point as shares of the image, and coefficients of curves that do not turn back.
@given(
    st.lists(st.floats(0.5, 1), min_size=2, max_size=2),
    st.lists(st.floats(0.45, 0.55), min_size=2, max_size=2),
    st.lists(st.floats(0, 1e-3), min_size=4, max_size=4),
    st.sampled_from([("kannala_brandt", 0), ("plumb_bob", 1)]),
    st.tuples(st.integers(1, 65_535), st.integers(1, 65_535)),
)
def test_written_camchain_reads_back_exactly(
    focal: list[float],
    centre: list[float],
    coefficients: list[float],
    model: tuple[str, int],
    size: tuple[int, int],
) -> None:
    K = np.diag([*np.array(focal) * max(size), 1.0])
    K[:2, 2] = np.array(centre) * size
    known = CameraCalibration(0, "red", *size, model[0], np.array(coefficients + [0.0] * model[1]), K)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "camchain.yaml")
        path.write_text(kalibr_yaml(known, {}, "comment"))
        found = read_intrinsics(path, "red")
    assert same_intrinsics(found, known)
    assert (found.width, found.height, found.frame_id) == (*size, "red")


def camchain(**changes: Any) -> dict[str, Any]:
    """Return a file of two cameras, as Kalibr writes them."""
    first = {
        "cam_overlaps": [1],
        "camera_model": "pinhole",
        "distortion_coeffs": [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 2e-4],
        "distortion_model": "equidistant",
        "intrinsics": [190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504],
        "resolution": [512, 480],
        "rostopic": "/cam0/image_raw",
    }
    pose = [[1.0, 0.0, 0.0, -0.1], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    second = {"T_cn_cnm1": pose, **first, "rostopic": "/lab/red/image_raw/compressed"}
    second |= {"distortion_model": "radtan", "intrinsics": [500.0, 501.0, 320.0, 240.0], **changes}
    # Without copies, YAML has references between the cameras.
    return copy.deepcopy({"cam0": first}) | copy.deepcopy({"cam1": second})


@pytest.mark.parametrize("is_flow", [True, False, None])
def test_camchain_of_several_cameras_is_read_by_topic(is_flow: bool | None, tmp_path: Path) -> None:
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = is_flow if is_flow is not True else None
    yaml.width = 60
    path = tmp_path / "camchain.yaml"
    with path.open("w") as file:
        yaml.dump(camchain(), file)
    second, first = read_intrinsics(path, "lab_red"), read_intrinsics(path, "cam0")
    assert (second.distortion_model, second.K[1, 1], second.D.size) == ("plumb_bob", 501.0, 5)
    assert (first.distortion_model, first.D.size, first.width, first.height) == (
        "kannala_brandt",
        4,
        512,
        480,
    )
    assert first.D.tolist() == camchain()["cam0"]["distortion_coeffs"]
    assert first.K[0, 2] == 254.93170605935475


@pytest.mark.parametrize(
    ("camera", "changes", "said"),
    [
        ("white", {}, "has the cameras cam0, cam1 or lab_red, but not one white"),
        ("cam1", {"camera_model": "omni"}, "cam1: the model omni-radtan is not read; calibrate with"),
        ("cam1", {"distortion_model": "fov"}, "cam1: the model pinhole-fov is not read"),
        (
            "cam1",
            {"intrinsics": [1.0, 2.0, 3.0]},
            "line 22: Kalibr camchain, cam1: intrinsics needs 4 numbers, but has 3",
        ),
        ("cam1", {"intrinsics": ["a", 2.0, 3.0, 4.0]}, "cam1: intrinsics is not a list of numbers"),
        ("cam1", {"intrinsics": ["nan", 2.0, 3.0, 4.0]}, "cam1: its matrix or coefficients"),
        ("cam1", {"resolution": [640, 1e9]}, "cam1: the image width and height must be 1 to 65535 pixels"),
        ("cam1", {"resolution": [640, "nan"]}, "cam1: the image width and height"),
    ],
)
def test_bad_camchain_is_refused(camera: str, changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    with path.open("w") as file:
        YAML(typ="safe", pure=True).dump(camchain(**changes), file)
    with pytest.raises(IpsysError, match=said):
        read_intrinsics(path, camera)


_PIECES = [
    "intrinsics:",
    " resolution: [1,2]",
    "\n",
    " ",
    "cam1:",
    "[",
    "]",
    "- 1.0",
    "\t",
    "rostopic: /a",
    "'",
]


@given(st.lists(st.sampled_from(_PIECES) | st.text(max_size=5), max_size=60))
def test_any_camchain_is_read_or_refused(pieces: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "camchain.yaml")
        path.write_text("cam0:\n camera_model: pinhole\n distortion_model: radtan\n" + "".join(pieces))
        with pytest.raises(IpsysError):
            read_intrinsics(path, "red")


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [("kalibr", "pinhole", "four coefficients"), ("matlab", "fisheye", "use one of opencv, ros, kalibr")],
)
def test_impossible_formats_are_refused(name: str, kind: str, said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        check_format(name, kind)


ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.78, 0., 305.59, 0., 437.35, 243.74, 0., 0., 1.]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{values}]
"""


@pytest.mark.parametrize(
    ("named", "values", "model", "d"),
    [
        ("plumb_bob", "-0.3, 0.1, 0.001, -0.002, 0.01", "plumb_bob", [-0.3, 0.1, 0.001, -0.002, 0.01]),
        ("plumb_bob", "-0.3, 0.1, 0.001, -0.002", "plumb_bob", [-0.3, 0.1, 0.001, -0.002, 0.0]),
        ("equidistant", "-0.1, 0.01, -0.03, 0.02", "kannala_brandt", [-0.1, 0.01, -0.03, 0.02]),
    ],
)
def test_a_camera_info_of_ros(tmp_path: Path, named: str, values: str, model: str, d: list[float]) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(ROS.format(model=named, values=values, count=values.count(",") + 1))
    lens = read_intrinsics(path, "red")
    assert (lens.width, lens.height, lens.distortion_model) == (640, 480, model)
    np.testing.assert_array_equal(lens.D, d)
    np.testing.assert_array_equal(lens.K, [[438.78, 0, 305.59], [0, 437.35, 243.74], [0, 0, 1]])


def test_the_authors_files(data: Path) -> None:
    lens = read_intrinsics(data / "imsel" / "cam_gnt_calib.yaml", "red")
    assert (lens.width, lens.height, lens.distortion_model) == (1920, 1080, "kannala_brandt")
    assert lens.K[0, 0] == 1.1516413720243977e03
    assert lens.D[3] == 1.6798029858339236e-02


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("%YAML:1.0\n---\ncamera_matrix: 5\n", "line 3: OpenCV: camera_matrix needs 9 numbers, but has 1"),
        ("no: [yaml", "line 1 is not valid YAML; correct this line"),
        ("", "this YAML has no camera matrix"),
        (ROS.format(model="mystery", values="0., 0., 0., 0.", count=4), "'mystery' is not known"),
        (ROS.format(model="plumb_bob", values="0., 0.", count=2), "takes 5 coefficients, found 2"),
    ],
)
def test_files_that_are_no_calibration(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(IpsysError, match=said):
        read_intrinsics(path, "red")
