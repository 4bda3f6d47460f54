"""Calibration files of other software."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import read_intrinsics

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
