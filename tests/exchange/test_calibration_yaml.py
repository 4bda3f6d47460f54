"""Written calibrations that other software reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import (
    check_format,
    kalibr_yaml,
    opencv_yaml,
    read_opencv_calibration,
    ros_yaml,
)
from ipsys_log.geometry.lenses import same_intrinsics
from ipsys_log.messages import CameraCalibration

COEFFICIENTS = {
    "kannala_brandt": (-0.1305, 0.0119, -0.0310, 1 / 3),
    "plumb_bob": (-0.33, 0.046, -0.0043, 0.0041, 1e-7),
    "rational_polynomial": (0.2, 0.05, 0.001, -0.002, 0.01, 0.3, 0.04, 0.002),
}


def lens(model: str) -> CameraCalibration:
    k = np.array([[1151.6 / 3, 0, 932.9], [0, 1148.8, 504.3], [0, 0, 1]])
    return CameraCalibration(0, "red", 1920, 1080, model, np.array(COEFFICIENTS[model]), k)


@pytest.mark.parametrize("model", list(COEFFICIENTS))
@pytest.mark.parametrize("write", [opencv_yaml, ros_yaml])
def test_written_calibration_reads_back_exactly(
    tmp_path: Path, model: str, write: Callable[..., str]
) -> None:
    path = tmp_path / "red.yaml"
    path.write_text(write(lens(model), {"fx": 1.5, "k1": 0.0}, "two\nlines"))
    assert same_intrinsics(read_opencv_calibration(path, "red"), lens(model))


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
    assert camera["intrinsics"] == [1151.6 / 3, 1148.8, 932.9, 504.3]
    assert camera["resolution"] == [1920, 1080]


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [("kalibr", "pinhole", "four coefficients"), ("matlab", "fisheye", "use one of opencv, ros, kalibr")],
)
def test_impossible_formats_are_refused(name: str, kind: str, said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        check_format(name, kind)
