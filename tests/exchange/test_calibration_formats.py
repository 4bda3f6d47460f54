"""Calibration files of other programs, with files that OpenCV writes as oracle."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import read_intrinsics
from tests.conftest import ROOT

K = np.array([[755.4, 0.0, 640.5], [0.0, 752.0, 360.5], [0.0, 0.0, 1.0]])
D = [-0.02, 0.003, -0.001, 0.0002]
ROWS = "[[755.4, 0.0, 640.5], [0.0, 752.0, 360.5], [0.0, 0.0, 1.0]]"
SIZE = "image_width: 1280\nimage_height: 720\n"
NESTED = (
    f"camera_matrix: {ROWS}\ndist_coeff: [[-0.02, 0.003, -0.001, 0.0002]]\ndistortion_model: fisheye\n{SIZE}"
)
UNNAMED = NESTED.replace("distortion_model: fisheye\n", "")
ECHO = """header:
  stamp: {sec: 1, nanosec: 2}
height: 720
width: 1280
distortion_model: equidistant
d:
- -0.02
- 0.003
- -0.001
- 0.0002
k: [755.4, 0.0, 640.5, 0.0, 752.0, 360.5, 0.0, 0.0, 1.0]
---
height: 7"""
INI = """# oST version 5.0 parameters
[image]
width
1280
height
720
[red]
camera matrix
755.4 0.000000 640.5
0.000000 752.0 360.5
0.000000 0.000000 1.000000
distortion
-0.02 0.003 -0.001 0.0002 0.0
rectification
1.0 0.0 0.0
"""
ANIPOSE = f"""[cam_0]
name = "white"
size = [ 640, 480,]
matrix = [[300.0, 0.0, 320.0], [0.0, 300.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0, 0.0]
[cam_1]
name = "red"
size = [ 1280, 720,]
matrix = {ROWS}
distortions = [-0.02, 0.003, -0.001, 0.0002, 0.0,]
fisheye = true
[metadata]
error = 0.31
"""
COLMAP = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {} 1280 720 {}\n"
FISHEYE = COLMAP.format("OPENCV_FISHEYE", "755.4 752.0 641.0 361.0 -0.02 0.003 -0.001 0.0002")
EUROC = """sensor_type: camera
resolution: [1280, 720]
camera_model: pinhole
intrinsics: [755.4, 752.0, 640.5, 360.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.02, 0.003, -0.001, 0.0002]
"""
# MATLAB transposes the matrix, counts pixels from 1, and gives rows before columns.
MATLAB = {
    "IntrinsicMatrix": [[755.4, 0, 0], [0, 752.0, 0], [641.5, 361.5, 1]],
    "ImageSize": [720, 1280],
    "RadialDistortion": [-0.02, 0.003],
    "TangentialDistortion": [-0.001, 0.0002],
}
MATLAB_K = {**MATLAB, "K": [[755.4, 0, 641.5], [0, 752.0, 361.5], [0, 0, 1]]}
MATLAB_TEXT = """cameraParams.IntrinsicMatrix = [755.4 0 0; 0 752 0; 641.5 361.5 1];
cameraParams.ImageSize = [720 1280]; % rows, columns
cameraParams.RadialDistortion = [-0.02 0.003];
cameraParams.TangentialDistortion = [-0.001 0.0002];
"""
OPENICC = {
    "image_width": 1280,
    "image_height": 720,
    "intrinsic_type": "FISHEYE",
    "intrinsics": {
        "focal_length": 755.4,
        "aspect_ratio": 752.0 / 755.4,
        "principal_pt_x": 640.5,
        "principal_pt_y": 360.5,
        **{f"radial_distortion_{number}": value for number, value in enumerate(D, 1)},
        "skew": 0.0,
    },
}
PINHOLE = ("plumb_bob", [*D, 0.0])


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_file_that_opencv_writes_is_read_exactly(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"red{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array(D))
    storage.write("distortion_model", "fisheye")
    storage.release()
    lens = read_intrinsics(path, "red")
    assert (lens.K.tolist(), lens.D.tolist()) == (K.tolist(), D)
    assert (lens.width, lens.height, lens.distortion_model) == (1280, 720, "kannala_brandt")


@pytest.mark.parametrize(
    ("text", "model", "coefficients"),
    [
        (NESTED, "kannala_brandt", D),
        (f"# Monday\n%YAML:1.0\n---\n{NESTED}", "kannala_brandt", D),
        (NESTED.replace("[[-0.02, 0.003, -0.001, 0.0002]]", "[-2e-2 3e-3 -1e-3 2e-4]"), "kannala_brandt", D),
        (NESTED.replace("[[755.4", "!!python/tuple [[755.4"), "kannala_brandt", D),
        (ECHO, "kannala_brandt", D),
        (INI, *PINHOLE),
        (ANIPOSE, "kannala_brandt", D),
        (FISHEYE, "kannala_brandt", D),
        (COLMAP.format("OPENCV", "755.4 752.0 641.0 361.0 -0.02 0.003 -0.001 0.0002"), *PINHOLE),
        (EUROC, *PINHOLE),
        (json.dumps(MATLAB), *PINHOLE),
        (json.dumps({"cameraParams": MATLAB_K}), *PINHOLE),
        (MATLAB_TEXT, *PINHOLE),
        (json.dumps(OPENICC), "kannala_brandt", D),
        (NESTED.replace("0.0002]]", "0.0002, 0.0]]"), "kannala_brandt", D),
        (UNNAMED.replace("0.0002]]", "0.0002" + ", 0." * 10 + "]]"), "rational_polynomial", [*D, 0, 0, 0, 0]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_file_of_another_program_is_read(
    tmp_path: Path, text: str, model: str, coefficients: list[float], encoding: str
) -> None:
    path = tmp_path / "red.txt"  # the contents count, not the name
    path.write_text(text, encoding=encoding)
    lens = read_intrinsics(path, "red")
    assert (lens.width, lens.height, lens.distortion_model) == (1280, 720, model)
    np.testing.assert_allclose(lens.K, K, rtol=1e-15)
    assert lens.D.tolist() == coefficients


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (NESTED.replace(SIZE, ""), "line 1: OpenCV: the image size is missing; add image_width and"),
        (NESTED.replace("image_height: 720\n", ""), "image_height in px"),
        (NESTED.replace("fisheye", "ds"), "line 3: OpenCV: distortion model 'ds' is not known"),
        (SIZE + "camera_matrix: [772,5, 0,0, 640,2, 0,0, 771,9, 360,4, 0,0, 0,0, 1,0]",
         "line 3: OpenCV: camera_matrix needs 9 numbers, but has 18; write decimal points, not commas"),
        (ECHO.replace("755.4", "0.0").replace("640.5", "0").replace("752.0", "0").replace("360.5", "0")
         .replace("0.0, 1.0]", "0.0, 0.0]"), "the camera matrix is zero: this camera was not calibrated"),
        (NESTED.replace("fisheye", "plumb_bob").replace("0.0002]]", "0.0002, 0.1, 0.1, 0.1, 0.1]]"),
         "plumb_bob takes 5 coefficients, found 8"),
        (UNNAMED.replace("0.0002]]", "0.0002" + ", 0.1" * 10 + "]]"), "thin prism"),
        (COLMAP.format("FOV", "755 752 640 360 0.9"), "COLMAP cameras.txt, 1: the model FOV is not read"),
        ("cam0:\n  camera_model: eucm\n  distortion_model: none\n  intrinsics: [1, 2, 3, 4, 5, 6]\n"
         "  resolution: [1280, 720]\n", "line 2: Kalibr camchain, cam0: the model eucm-none is not"),
        ('name = "lab"\ndictionary = "DICT_4X4_50"\n', "is a rig file; name the calibration file"),
        ('{"MappingCoefficients": [1, 2, 3, 4]}', "MATLAB fisheyeIntrinsics: the model of Scaramuzza is not"),
        ("matrix = [\n", "not valid TOML"),
        ('{"camera_matrix": [1, 2', "line 1 is not valid JSON"),
    ],
)  # fmt: skip
def test_refusal_names_format_line_and_key(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "red.txt"
    path.write_text(text)
    with pytest.raises(IpsysError) as caught:
        read_intrinsics(path, "red")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def with_matrix(rows: list[list[float]]) -> str:
    return NESTED.replace(ROWS, str(rows))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (with_matrix(K.T.tolist()), "is transposed"),
        (with_matrix(K[[1, 0, 2]].tolist()), "not in the form fx 0 cx"),
        (with_matrix([[755.4, 0, 640.5], [0.1, 752, 360.5], [0, 0, 1]]), "K[1, 0] is 0.1"),
        (with_matrix([[755.4, 0, 640.5], [0, 752, 360.5], [0, 0, 2]]), "its last row is [0.0, 0.0, 2.0]"),
        (with_matrix([[755.4, 2.84, 640.5], [0, 752, 360.5], [0, 0, 1]]), "a skew of 2.84 px"),
        (with_matrix([[377.7, 0, 320.2], [0, 376, 180.2], [0, 0, 1]]), "of images of about 641 x 360 px"),
        (with_matrix([[755.4, 0, 960.5], [0, 752, 540.5], [0, 0, 1]]), "of images of about 1921 x 1081 px"),
        (with_matrix([[755.4, 0, 1300], [0, 752, 360], [0, 0, 1]]), "is outside images of 1280 x 720 px"),
        (with_matrix([[3.6, 0, 640.5], [0, 3.6, 360.5], [0, 0, 1]]), "give them in pixels"),
        (with_matrix([[755.4, 0, 640.5], [0, 100, 360.5], [0, 0, 1]]), "pixels that are not square"),
        (NESTED.replace("1280", "720").replace("height: 720", "height: 1280"), "exchange width and height"),
        (NESTED.replace("0.0002]]", ".Nan]]"), "are not valid"),
        (NESTED.replace("-0.02, 0.003, -0.001, 0.0002", "-1.15, 2.91, -2.48, 0.178"), "turns back inside"),
        (NESTED.replace("fisheye", "plumb_bob").replace("-0.02, 0.003", "-0.9, 0.0"), "turns back inside"),
    ],
)
def test_values_of_no_camera_are_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "red.yaml"
    path.write_text(text)
    with pytest.raises(IpsysError) as caught:
        read_intrinsics(path, "red")
    assert said in str(caught.value)


# Expected answers: None for a file that is read, else a part of the refusal.
CASES = {
    "camchain-ds.yaml": "the model ds-none is not read",
    "camchain-eucm.yaml": "the model eucm-none is not read",
    "camchain-omni.yaml": "the model omni-radtan is not read",
    "echo_skew.yaml": "skew",
    "folding_opencv.yaml": "turns back",
    "half_centre.yaml": "principal point",
    "komma.yaml": "decimal points",
    "lab.toml": "is a rig file",
    "lab15.toml": "is a rig file",
    "nosize.yaml": "the image size is missing",
    "openicc_half.json": "principal point",
    "printed.yaml": "the image size is missing",
    "ros_fisheye_k0.yaml": "not calibrated",
    "ros_rational_d5.yaml": "takes 5 coefficients, found 8",
    "rows_swapped.yaml": "exchange width and height",
    "skew_opencv.yaml": "skew",
}


def test_each_shared_case_is_read_or_refused_with_a_reason() -> None:
    folder = Path(os.environ.get("IPSYS_CASES", ROOT / "../shared/cases")).resolve() / "calibration"
    if not folder.is_dir():
        pytest.skip(f"no faulty inputs in {folder}: set IPSYS_CASES")
    for path in sorted(folder.iterdir()):
        try:
            read_intrinsics(path, "red")
            refusal = None
        except IpsysError as error:
            refusal = str(error)
        said = CASES.get(path.name)
        assert (refusal is None) == (said is None), f"{path.name}: {refusal}"
        assert said is None or said in str(refusal), refusal


@pytest.mark.parametrize(
    ("text", "is_reported"),
    [
        (NESTED, False),
        (UNNAMED, True),
        (NESTED.replace("fisheye", "''"), True),
        (UNNAMED.replace("0.0002]]", "0.0002, 0]]"), False),
    ],
)
def test_assumed_model_is_reported(tmp_path: Path, text: str, is_reported: bool) -> None:
    path = tmp_path / "red.yaml"
    path.write_text(text)
    reported: dict[str, str] = {}
    read_intrinsics(path, "red", reported.__setitem__)
    assert ("state it in the file: distortion_model: " in reported.get("red", "")) == is_reported
