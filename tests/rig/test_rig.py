"""The rig file: read, checked, and written so that it reads back."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Floor, ReferencePoint, Rig, RigBody, RigCamera, RigMarker
from ipsys_log.messages.rig_checks import dictionary_size
from ipsys_log.messages.rig_file import check_rig, example_toml, load_rig, rig_toml
from ipsys_log.plain_text import hide_password

RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    markers=(RigMarker(0, 0.15, "ada", 0.25), RigMarker(7)),
    cameras=(RigCamera("red"),),
    reference_points=(ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0)),
    floor=Floor(4.0, 5.0),
    marker_height_m=0.1,
    tape_sigma_m=0.003,
)


DRONE = replace(
    RIG,
    markers=(
        RigMarker(1, robot="drone"),
        RigMarker(2, robot="drone", xyz_m=(0.2, 0.0, -0.1), rpy_rad=(0, 0, 0.5)),
    ),
    bodies=(RigBody("drone", level=False, pivot_m=(0.0, 0.05, -0.1), scale_sigma=0.0002),),
)


def test_written_rig_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    bare = replace(RIG, markers=(), cameras=(), reference_points=(), floor=None)
    for rig in (RIG, replace(bare, marker_height_m=None, tape_sigma_m=None), DRONE):
        path.write_text(rig_toml(rig))
        assert load_rig(path) == rig


@given(st.floats(0, 5), st.floats(0, 0.1, exclude_min=True), st.none() | st.floats(0, 5))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_heights_and_sigma_read_back_to_the_last_digit(
    tmp_path: Path, height_m: float, sigma_m: float, own_m: float | None
) -> None:
    path = tmp_path / "lab.toml"
    rig = replace(
        RIG, marker_height_m=height_m, tape_sigma_m=sigma_m, markers=(RigMarker(3, height_m=own_m),)
    )
    path.write_text(rig_toml(rig))
    assert load_rig(path) == rig


def test_commented_examples_of_init_are_valid(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(example_toml())
    plain = load_rig(path)
    assert (plain.marker_height_m, plain.tape_sigma_m) == (None, None)
    keys = "marker_height_m|tape_sigma_m|length_m|height_m"
    text, changed = re.subn(rf"^# ((?:{keys}) = )", r"\1", example_toml(), flags=re.MULTILINE)
    assert changed == 4
    path.write_text(text)
    full = load_rig(path)
    assert (full.marker_height_m, full.tape_sigma_m) == (0.10, 0.003)
    assert full.markers[0].height_m is not None
    assert full.height_of(0) == full.markers[0].height_m
    assert "A third reference point" in text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tape_sigma_m": 0.0}, "tape_sigma_m = 0.0 m is not a standard deviation"),
        ({"tape_sigma_m": -0.003}, "tape_sigma_m = -0.003"),
        ({"tape_sigma_m": float("nan")}, "tape_sigma_m = nan"),
        ({"tape_sigma_m": float("inf")}, "tape_sigma_m = inf"),
        (
            {"marker_height_m": -0.1},
            "marker_height_m is -0.1 m; give the height above the floor in m, 0 to 5",
        ),
        ({"marker_height_m": 10.0}, "marker_height_m is 10.0 m"),
        ({"marker_height_m": float("nan")}, "marker_height_m is nan m"),
        ({"markers": (RigMarker(0, height_m=25.0),)}, "height_m of marker 0 is 25.0 m"),
        ({"markers": (RigMarker(4, height_m=float("inf")),)}, "height_m of marker 4 is inf m"),
        (
            {"reference_points": (ReferencePoint("A", float("nan"), 0.0),)},
            "'A' has the coordinates nan and 0.0",
        ),
        (
            {"reference_points": (ReferencePoint("A", 0.0, float("inf")),)},
            "'A' has the coordinates 0.0 and inf",
        ),
        (
            {"reference_points": (ReferencePoint("A", 1.0, 2.0), ReferencePoint("B", 1.0002, 2.0))},
            r"two reference points are at \(1.0, 2.0\); give each its own",
        ),
        ({"marker_length_m": 0.0}, "0.0 m is not a length"),
        ({"markers": DRONE.markers}, r"robot 'drone' has several markers; add \[\[bodies\]\]"),
        ({"bodies": DRONE.bodies}, "no marker has the robot 'drone'"),
        (
            {"markers": DRONE.markers, "bodies": (RigBody("drone", False, (50.0, 0.0, -100.0)),)},
            r"pivot_m of drone is \[50.0, 0.0, -100.0\]; give m, at most 5",
        ),
        ({"bodies": (RigBody("ada", True, (0.1, 0.2)),)}, "pivot_m of ada needs three numbers"),
        ({"bodies": (RigBody("ada", True), RigBody("ada", False))}, "two bodies have the robot 'ada'"),
        ({"bodies": (RigBody("ada", True, scale_sigma=0.1),)}, "scale_sigma of ada is 0.1; write 0.001"),
        (
            {
                "markers": (RigMarker(0, robot="ada"),),
                "marker_height_m": None,
                "bodies": (RigBody("ada", True),),
            },
            "ada is level, but its marker 0 has no height_m",
        ),
        (
            {
                "markers": tuple(RigMarker(n, robot="ada", xyz_m=(0.1, 0.0, 0.0)) for n in (1, 2)),
                "bodies": (RigBody("ada", False),),
            },
            r"two markers of ada are at \(0.1, 0.0, 0.0\)",
        ),
    ],
)
def test_impossible_rig_is_refused(change: dict[str, object], said: str) -> None:
    assert check_rig(RIG, "lab.toml") is RIG
    with pytest.raises(IpsysError, match=f"^lab.toml: .*{said}"):
        check_rig(replace(RIG, **change), "lab.toml")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"marker_length_m": 20.0},
            "marker_length_m = 20 is too large for m; write 0.2 if it is in cm or 0.02",
        ),
        (
            {"markers": (RigMarker(3, length_m=150.0),)},
            "marker 3: length_m = 150 .* write 1.5 if it is in cm or",
        ),
        ({"markers": (RigMarker(100),)}, "marker id 100: DICT_4X4_100 has only the ids 0 to 99"),
        (
            {"floor": Floor(488.0, 4.88)},
            r"\[floor\] width_m = 488 is too large for m; write 4.88 if it is in cm",
        ),
        ({"reference_points": (ReferencePoint("A", 122.0, 0.0),)}, "reference point A: x_m = 122"),
        ({"tape_sigma_m": 1.0}, "tape_sigma_m = 1 .* write 0.01 if it is in cm or 0.001 if it is in mm"),
        ({"cameras": (RigCamera("red", rate_hz=3000.0),)}, "camera red: rate_hz = 3000 .*; write 0 to 1000"),
        ({"cameras": (RigCamera("red", exposure_s=8.0),)}, "exposure_s = 8 .* write 0.008 if it is in ms"),
        ({"cameras": (RigCamera("red", row_time_ns=31),)}, "too small for ns; write 31000 if it is in us"),
    ],
)
def test_rig_file_with_a_wrong_unit_is_refused(tmp_path: Path, change: dict[str, object], said: str) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(rig_toml(replace(RIG, **change)))  # type: ignore[arg-type]
    with pytest.raises(IpsysError, match=f"lab.toml: .*{said}"):
        load_rig(path)


def test_unusual_labs_are_not_refused(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    cameras = (
        RigCamera("fast", 0, -1.0, rate_hz=1000.0, exposure_s=2e-5),
        RigCamera("slow", 200_000, rate_hz=0.1, exposure_s=1.0, width=1080, height=1920),
    )
    for size_m, marker_m, sigma_m in ((0.3, 0.005, 0.0001), (90.0, 1.5, 0.05)):
        rig = replace(
            RIG, marker_length_m=marker_m, tape_sigma_m=sigma_m, floor=Floor(size_m, size_m),
            cameras=cameras, markers=(RigMarker(99, 1.0),),
            reference_points=(ReferencePoint("A", -size_m, 0.0), ReferencePoint("B", size_m, size_m)),
        )  # fmt: skip
        path.write_text(rig_toml(rig))
        assert load_rig(path) == rig


def test_the_sizes_of_all_dictionaries_are_those_of_opencv() -> None:
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    assert len(names) > 20
    for name in names:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList
        assert dictionary_size(name) == len(markers), name


def test_the_floor_itself_is_a_height() -> None:
    grounded = replace(RIG, marker_height_m=0.0, markers=(RigMarker(0, height_m=0.0),))
    assert check_rig(grounded, "lab.toml").height_of(0) == 0.0


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("rtsp://admin:se/c:r@et?#@10.0.0.7:554/live", "rtsp://admin:***@10.0.0.7:554/live"),
        ("rtsp://admin:1234/x@10.0.0.7/live", "rtsp://admin:***@10.0.0.7/live"),
        ("rtsp://first.last:1234/x@10.0.0.7/live", "rtsp://first.last:***@10.0.0.7/live"),
        ("rtsp://token@10.0.0.7/live", "rtsp://***@10.0.0.7/live"),
        ("http://u:pw@[fe80::1]:80/x", "http://u:***@[fe80::1]:80/x"),
        ("rtsp://10.0.0.7:554/user=admin&password=secret&channel=1",
         "rtsp://10.0.0.7:554/user=admin&password=***&channel=1"),
        ("http://h/v?loginuse=a&loginpas=b", "http://h/v?loginuse=a&loginpas=***"),
        ("http://h/v?psw=a&n=1", "http://h/v?psw=***&n=1"),
        ("http://h/v?passphrase=a&n=1", "http://h/v?passphrase=***&n=1"),
        ("http://h/v?Token=a&n=1", "http://h/v?Token=***&n=1"),
        ("http://h/v?auth=YWRtaW4=&n=1", "http://h/v?auth=***&n=1"),
        ("http://h/v?api_key=a&n=1", "http://h/v?api_key=***&n=1"),
        ("http://h/v?secret=a&n=1", "http://h/v?secret=***&n=1"),
        ("http://h/v?pwd=a;b", "http://h/v?pwd=***"),
        ("rtsp://10.0.0.7:554/live?to=a@b", "rtsp://10.0.0.7:554/live?to=a@b"),
        ("rtsp://camera:554/live?rate=30", "rtsp://camera:554/live?rate=30"),
        ("rtsp://[fe80::1]:554/live", "rtsp://[fe80::1]:554/live"),
        ("usb:/dev/video0", "usb:/dev/video0"),
    ],
)  # fmt: skip
def test_only_the_password_is_hidden(address: str, shown: str) -> None:
    assert hide_password(address) == shown
    assert hide_password(shown) == shown


def test_floor_is_below_the_pivots_of_level_robots_only() -> None:
    markers = (
        RigMarker(0, robot="ada", height_m=0.3, xyz_m=(0.0, 0.0, 0.1)),
        RigMarker(1, robot="bob", height_m=0.2),
        RigMarker(2, robot="eve", height_m=0.2),
    )
    bodies = (RigBody("ada", level=True, pivot_m=(0.1, 0.0, -0.15)), RigBody("eve", level=False))
    heights_m = Rig("lab", "DICT_4X4_100", 0.2, markers, bodies=bodies).robot_heights_m()
    assert heights_m == {"ada": pytest.approx(0.05), "bob": 0.2, "eve": None}
