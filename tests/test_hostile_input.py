"""Input with excessive or impossible values: one line, never a traceback, and little memory."""

import re
import resource
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
from google.protobuf.timestamp_pb2 import Timestamp

from ipsys_log.calibration.images import _decode
from ipsys_log.errors import FrameError, IpsysError
from ipsys_log.exchange.calibration_files import read_intrinsics
from ipsys_log.exchange.image_folders import find_times, parse_time
from ipsys_log.exchange.imsel import read_mat
from ipsys_log.live_runs.survey.checks import next_id
from ipsys_log.live_runs.survey.sheet import read_sheet
from ipsys_log.log.codec import decode, encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CameraCalibration,
    CameraPoint,
    CameraPoints,
    CompressedImage,
    Measurement,
    Message,
    RawImage,
    ReferencePoint,
    Rig,
    RigMarker,
)
from ipsys_log.messages.rig_file import check_rig, load_rig
from ipsys_log.statistics.calibration_points import gather_sightings
from ipsys_log.vision.decode import check_encoded, decode_grey, decode_rows
from ipsys_log.vision.lenses import check_calibration
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys
from tests.log.bombs import jpeg_head

RIG = Rig(
    "lab", "DICT_4X4_100", 0.2, (RigMarker(1),),
    reference_points=(ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0)),
)  # fmt: skip
NEEDED = 'name = "a"\ndictionary = "DICT_4X4_100"\nmarker_length_m = '


def one_line(error: pytest.ExceptionInfo[IpsysError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 500
    return text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = " + "[" * 5_000 + "]" * 5_000, "thousands deep"),
        ("a = " + "{b = " * 5_000 + "1" + "}" * 5_000, "thousands deep"),
        (f"a = {'9' * 5_000}", "thousands of digits"),
        (NEEDED + "9" * 400, "at most"),
        (NEEDED + "1e308", "at most"),
        (NEEDED + "nan", "at most"),
        (NEEDED + "0.2\ntape_sigma_m = -inf", "at most"),
        (NEEDED + f"0.2\n[[markers]]\nid = {1 << 70}", "at most"),
        (NEEDED + f"0.2\n[[markers]]\nid = {'[' * 90}{']' * 90}", "whole number"),
        (f"name = {'x' * 100_000}", "text needs quotes"),
        ("#" * (1 << 20), "too large"),
    ],
)
def test_rig_file_beyond_all_bounds_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(text)
    with pytest.raises(IpsysError) as caught:
        load_rig(path)
    assert said in one_line(caught)


@pytest.mark.parametrize("value", [1e308, -1e308, 1e12])
def test_rig_of_a_log_with_a_huge_coordinate_is_refused(value: float) -> None:
    rig = replace(RIG, reference_points=(ReferencePoint("A", value, 0.0), ReferencePoint("B", 1.0, 0.0)))
    with pytest.raises(IpsysError, match="x_m is"):
        check_rig(rig, "a.mcap")


LENS = """%YAML:1.0
---
image_width: {width}
image_height: 540
camera_matrix: !!opencv-matrix
   rows: {rows}
   cols: 3
   dt: d
   data: [ 500., 0., 480., 0., 500., 270., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0., 0., 0., 0. ]
"""


@pytest.mark.parametrize("width", ['"many"', "1e30", ".Inf", ".Nan", "-960", "99999999999", "[1, 2]", "0"])
def test_lens_file_with_a_wrong_width_is_one_line(tmp_path: Path, width: str) -> None:
    path = tmp_path / "lens.yaml"
    path.write_text(LENS.format(width=width, rows=3))
    with pytest.raises(IpsysError) as caught:
        read_intrinsics(path, "red")
    assert str(path) in one_line(caught)


@pytest.mark.parametrize("rows", ["1000000", "-3", "1e9", "text"])
def test_lens_file_with_a_wrong_matrix_is_one_line(tmp_path: Path, rows: str) -> None:
    path = tmp_path / "lens.yaml"
    text = LENS.format(width=960, rows=rows)
    path.write_text(re.sub(r"data: \[ 500.*\]", "data: 5.", text))
    with pytest.raises(IpsysError) as caught:
        read_intrinsics(path, "red")
    one_line(caught)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yaml", "%YAML:1.0\n---\na: " + "[" * 50_000),
        ("a.yaml", "%YAML:1.0\n---\na: " + "{ a: " * 50_000),
        ("a.json", '{"a": ' + "[" * 50_000),
        ("a.xml", '<?xml version="1.0"?>\n<opencv_storage>' + "<a>" * 50_000),
        ("a.yaml", "a: \0"),
        ("a.yaml", "\udcff"),
        ("a.yaml", "a" * (2 << 20)),
    ],
)
def test_lens_file_of_many_levels_is_one_line(tmp_path: Path, name: str, text: str) -> None:
    """Run in a separate process: OpenCV's reader would end the process."""
    path = tmp_path / name
    path.write_text(text, errors="surrogateescape")
    code = (
        "import sys, pathlib\nfrom ipsys_log.errors import IpsysError\n"
        "from ipsys_log.exchange.calibration_files import read_intrinsics as read\n"
        "try: read(pathlib.Path(sys.argv[1]), 'red')\nexcept IpsysError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "is not a calibration" in done.stdout


@pytest.mark.parametrize("change", ["nan", "huge", "zero focal length", "size", "no size"])
def test_impossible_calibration_of_a_log_is_refused(change: str) -> None:
    K, D = np.array([[500.0, 0, 480], [0, 500, 270], [0, 0, 1]]), np.zeros(4)
    K[0, 2] = {"nan": np.nan, "huge": 1e308}.get(change, 480.0)
    K[0, 0] = 0.0 if change == "zero focal length" else 500.0
    width = {"size": 1 << 31, "no size": 0}.get(change, 960)
    with pytest.raises(IpsysError):
        check_calibration(CameraCalibration(0, "a", width, 540, "kannala_brandt", D, K), "a")


SHEET = "marker,d_A_cm,d_B_cm,side,height_cm,place,time\n"


@pytest.mark.parametrize(
    "text",
    [
        SHEET + "1," + "1" * 140_000 + ",100,left,0,,\n",
        "m" * 140_000 + ",d_A_cm\n1,2\n",
        SHEET + f"1,100,150,left,0,{'9' * 5_000},\n",
        SHEET + f"1,100,150,left,0,,{'9' * 5_000}\n",
        SHEET + f"{'9' * 5_000},100,150,left,0,,\n",
        SHEET + "1,1e308,1e308,left,1e308,,\n",
        SHEET + "1,100,150,left,0,,1e400\n",
    ],
)
def test_sheet_beyond_all_bounds_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "sheet.csv"
    path.write_text(text)
    with pytest.raises(IpsysError, match=re.escape(str(path))):
        read_sheet(path, RIG, 0)


def test_table_of_times_beyond_all_bounds_is_refused(tmp_path: Path) -> None:
    picture, path = tmp_path / "red" / "1.jpg", tmp_path / "times.csv"
    for time in ("1" * 140_000, "9" * 5_000, "1e999999", "nan"):
        path.write_text(f"file,time\nred/1.jpg,{time}\n")
        with pytest.raises(IpsysError, match=r"times\.csv"):
            find_times({"red": [picture]}, str(path))
    with pytest.raises(ValueError, match="1e"):
        parse_time("1e999999999")


def jpeg(size: tuple[int, int]) -> bytes:
    return cv2.imencode(".jpg", np.zeros(size, np.uint8))[1].tobytes()


@pytest.mark.parametrize("read", [decode_grey, decode_rows])
def test_jpeg_that_claims_gigabytes_takes_no_memory(read: Callable[[Any], Any]) -> None:
    for data in (jpeg_head(65_500, 65_500), jpeg_head(20_000, 5_000), jpeg_head(65_500, 65_500)[:-2]):
        frame = CompressedImage(0, "a", data, "jpeg")
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(FrameError, match="px"):
            read(frame)
        assert _decode(data) is None
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_png_that_claims_gigabytes_takes_no_memory() -> None:
    data = bytearray(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    with pytest.raises(FrameError, match="60000 x 60000"):
        decode_grey(CompressedImage(0, "a", bytes(data), "png"))


@pytest.mark.parametrize("size", [(8, 8), (3000, 4000), (1, 1), (16, 4000)])
@pytest.mark.parametrize("options", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_OPTIMIZE, 1]])
def test_jpeg_of_one_colour_is_read(size: tuple[int, int], options: list[int]) -> None:
    """Return the smallest encoded image of a given size."""
    for picture in (np.zeros(size, np.uint8), np.zeros((*size, 3), np.uint8)):
        data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 1, *options])[1].tobytes()
        check_encoded(data)
        assert decode_grey(CompressedImage(0, "a", data, "jpeg")).shape == size


@pytest.mark.parametrize("size", [(0, 0), (0, 4), (4, 0), (1 << 31, 0), (1 << 31, 1 << 31)])
def test_raw_image_without_pixels_is_no_picture(size: tuple[int, int]) -> None:
    for encoding in ("mono8", "rgb8"):
        frame = RawImage(0, "a", *size, encoding, 0, bytes(100))
        with pytest.raises(FrameError):
            decode_grey(frame)


@pytest.mark.parametrize("length_m", [1e308, float("inf"), float("nan"), -1e308])
def test_tape_of_any_length_is_one_line(ipsys: Ipsys, lab: Path, length_m: float) -> None:
    def longer(message: Message) -> Message:
        payload = message.payload
        if isinstance(payload, Measurement) and payload.distances:
            distances = tuple(replace(tape, distance_m=length_m) for tape in payload.distances)
            return replace(message, payload=replace(payload, distances=distances))
        return message

    log = rewrite(lab, longer)
    before = log.read_bytes()
    for command in (["fit", log], ["view", log, "--save", lab.with_name("a.rrd")]):
        done = ipsys(*command)
        assert done.code in (0, 1)
        assert "Traceback" not in done.err
    assert ipsys("fit", log).code == 1
    assert "m is too long" in ipsys("fit", log).err
    assert log.read_bytes() == before


@pytest.mark.parametrize("time_ns", [1 << 63, (1 << 64) - 1])
def test_time_from_two_to_the_63_on_is_one_line(ipsys: Ipsys, lab: Path, time_ns: int) -> None:
    """Rerun and NumPy count nanoseconds with 63 bits."""
    from ipsys_log.log.writer import LogWriter

    with LogWriter.append(lab) as log:
        schema = None
        with Session([lab]) as session:
            [reader] = session.readers
            schema = reader.channels["/cameras/red/image"].schema
        log.add_channel("/cameras/red/image", schema)
        log.write("/cameras/red/image", time_ns, time_ns, encode(CompressedImage(0, "red", b"", "jpeg")))
    for command in (
        ["view", lab, "--save", lab.with_name("a.rrd")],
        ["detect", lab, "-o", lab.with_name("b.mcap")],
    ):
        done = ipsys(*command)
        assert done.code == 1
        assert re.fullmatch(r"(.*\n)?ipsys: [^\n]*later than the year 2262[^\n]*\n", done.err)
    assert ipsys("info", lab).code == 0


def test_time_within_a_payload_beyond_63_bits_is_refused() -> None:
    stamp = Timestamp(seconds=(1 << 63) - 1).SerializeToString()
    data = b"\x0a" + bytes([len(stamp)]) + stamp
    with pytest.raises(IpsysError, match="2262"):
        decode("foxglove.CompressedImage", data)


@pytest.mark.parametrize("x_m", [1e308, float("nan"), float("-inf")])
def test_camera_point_outside_every_lab_is_refused(x_m: float) -> None:
    points = CameraPoints(0, (CameraPoint(1, x_m, 0.0, 2.0),))
    with pytest.raises(IpsysError, match="camera red: a camera point of marker 1"):
        gather_sightings([Message("/runs/r/cameras/red/camera_points", 0, 0, points, "red")])


def test_next_id_after_an_endless_number_is_the_first() -> None:
    assert next_id([Measurement(0, "p" + "9" * 5_000), Measurement(0, "p٣")]) == "p001"


def test_mat_file_with_an_unknown_type_does_not_end_the_process(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    table = np.arange(12.0).reshape(4, 3)
    for packed in (False, True):
        for kind in (np.float64, np.float32, np.int16, np.uint8):
            scipy.io.savemat(path, {"Xc_red": table.astype(kind), "n": 3.0}, do_compression=packed)
            assert np.array_equal(read_mat(path)["Xc_red"], table)
    scipy.io.savemat(path, {"Xc_red": table})
    whole = path.read_bytes()
    for at in range(128, len(whole) - 96, 4):
        for value in (0, 8, 0xBA06, 0x5F6358, 1 << 31, (1 << 32) - 1):
            path.write_bytes(whole[:at] + struct.pack("<I", value) + whole[at + 4 :])
            with suppress(IpsysError):
                read_mat(path)
