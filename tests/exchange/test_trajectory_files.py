"""Files of other systems as trajectories: layouts with one known pose, and the errors of wrong files."""

import os
import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_typestore

from ipsys_log import IpsysError
from ipsys_log.exchange.ros_bags import message_types
from ipsys_log.exchange.trajectory_columns import GivenUnits
from ipsys_log.exchange.trajectory_files import TrajectoryFile, Wanted, assign_robots, read_trajectories
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import TRACKS
from ipsys_log.statistics.trajectories import Trajectory
from tests.conftest import ROOT
from tests.exchange.driven_lab import write_lab


def lines(*texts: str) -> str:
    return "\n".join(texts)


def tabs(*texts: str) -> str:
    return "\n".join(texts).replace("|", "\t")


def motive(version: str, rotation: str, unit: str) -> str:
    about = {
        **{"Format Version": version, "Take Name": "T", "Export Frame Rate": "100.000000"},
        **{"Capture Start Time": "2026-05-04 03.30.02.695 PM", "Rotation Type": rotation},
        **{"Length Units": unit, "Coordinate Space": "Global"},
    }
    return ",".join(f"{name},{value}" for name, value in about.items()) + "\n"


# The first pose of each file is at 10 s (see _AT_S), in (1, 2, 0.1) m, turned by 90 degrees about z.
_TURN = "0,0,0.70710678,0.70710678"
_QTM = "NO_OF_FRAMES|2\nNO_OF_CAMERAS|8\nFREQUENCY|100\nTIME_STAMP|2026-05-04, 15:30:02|47.1\nDATA_INCLUDED|"
_ROT = "|".join(f"Rot[{number}]" for number in range(9))
_UPRIGHT = np.pi / 4 + np.arange(9) / 20
_LAYOUTS = {
    "units_and_order.csv": lines(
        "z_mm,heading_deg,y [cm],time_ms,x (m)", "100,90,200,10000,1", "101,91,201,10010,1.1"
    ),
    "spreadsheet.csv": lines("\ufefftime_s;x_m;y_m;z_m;yaw_rad", "10,0;1,0;2,0;0,1;1,570796327"),
    "quoted.csv": lines("time_s,x_m,y_m,z_m,yaw_deg", '"10,0","1,0","2,0","0,1","90,0"'),
    "angles.tsv": tabs("t_us|x_m|y_m|z_m|roll_deg|pitch_deg|yaw_deg", "10000000|1|2|0.1|0|0|90"),
    "euroc.csv": lines(
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
        "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]",
        "10000000000,1,2,0.1,0.70710678,0,0,0.70710678,9,9,9",
    ),
    "w_first.csv": lines(
        *(
            f"{10**10 + n * 10**7},{1 + n},2,0.1,{np.cos(a)},0,0,{np.sin(a)}"
            for n, a in enumerate(_UPRIGHT.tolist())
        )
    ),
    "rostopic.csv": lines(
        "%time,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
        "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,"
        "field.pose.orientation.w,field.twist.linear.x",
        f"1700000011000000000,1700000010000000000,1,2,0.1,{_TURN},3",
    ),
    "no_stamp.csv": lines(
        "%time,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z,yaw",
        *("10000000000,0,1,2,0.1,1.5707963", "10100000000,0,1,2,0.1,1.6"),
    ),
    "bagpy.csv": lines(
        "Time,header.stamp.secs,header.stamp.nsecs,pose.pose.position.x,pose.pose.position.y,"
        "pose.pose.position.z,qx,qy,qz,qw",
        f"1700000011.5,1700000010,250000000,1,2,0.1,{_TURN}",
    ),
    "cflib.csv": lines(
        "timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z,stateEstimate.yaw,stateEstimate.vx",
        *("10000,1,2,0.1,90,5", "10010,1,2,0.1,91,5"),
    ),
    "sec_nanosec.csv": lines(
        "sec,nanosec,x [m],y [m],z [m],yaw,x [m/s],y [m/s],vel_x,vel_y", "10,0,1,2,0.1,1.5707963,3,4,5,6"
    ),
    "unnamed_units.csv": lines("timestamp,x,y,z,qx,qy,qz,qw", f"10.0,1,2,0.1,{_TURN}", f"10.1,1,2,0,{_TURN}"),
    "bodies.csv": lines(
        "time_s,robot_1_x_m,robot_1_y_m,robot_1_z_m,robot_1_yaw_deg,Robot 2 x (mm),Robot 2 y (mm)",
        "10,1,2,0.1,90,4000,5000",
    ),
    "counted.csv": lines(
        "name,t_ms,x_m,y_m,z_m,yaw", *(f"{n},{10000 + n},1,2,0.1,1.5707963" for n in range(20))
    ),
    "pandas.csv": lines("time,x,y,z,w,x.1,y.1,z.1", f"10,{_TURN},1,2,0.1", f"11,{_TURN},1,2,0.2"),
    "comments.dat": lines(
        *("# a data set", "# Time [s]    x [m]    y [m]   z [m]   orientation [rad]"),
        "10 \t1 \t2 \t0.1 \t1.5707963",
    ),
    "plain.tum": lines(
        "# timestamp tx ty tz qx qy qz qw", "10 1 2 0.1 0 0 0.70710678 0.70710678", "13 1 2 0.1 0 0 0 1"
    ),
    "tabs.tum": tabs("10|1|2|0.1|0|0|0.70710678|0.70710678"),
    "kitti.txt": "10.0 0 -1 0 1 1 0 0 2 0 0 1 0.1",
    "motive_1.23.csv": motive("1.23", "Quaternion", "Meters")
    + lines(
        *("", ",Type" + ",Rigid Body" * 8, ",Name" + ",ada" * 8, ",ID" + ",07" * 8),
        ",," + "Rotation," * 4 + "Position," * 3 + "Mean Marker Error",
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,",
        *("0,10.0,0,0.70710678,0,0.70710678,1,0.1,-2,0.0001", "1,10.01,,,,,,,,"),
    ),
    # Motive 3: parents, time codes, angles, and a marker beside the body.
    "motive_1.25.csv": motive("1.25", "XYZ", "Millimeters")
    + lines(
        *(",Type," + ",Rigid Body" * 6 + ",Marker" * 3, ",Name," + ",ada" * 6 + ",ada:1" * 3),
        *(",ID," + ",07" * 6 + ",08" * 3, ",Parent,,,,,,,,ada,ada,ada"),
        ",,," + "Rotation," * 3 + "Position," * 5 + "Position",
        "Frame,Time (Seconds),TimeCode,X,Y,Z,X,Y,Z,X,Y,Z",
        "0,10.0,15:30:02:01.00,0,90,0,1000,100,-2000,1,1,1",
    ),
    "motive_1.20.csv": motive("1.20", "Quaternion", "Centimeters")
    + lines(
        *(",,Marker,Marker,Marker", ",,m,m,m", ",,1,1,1", ",,Position,Position,Position"),
        *("Frame,Time,X,Y,Z", "0,10.0,100,10,-200"),
    ),
    "tracker.csv": lines(
        *("Objects", "100", ",,Global Angle ada:ada,,,,,", "Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ"),
        *(",,rad,rad,rad,mm,mm,mm", "1001,0,0,0,1.570796327,1000,2000,100", "1002,0" + ",0" * 6),
    ),
    "tracker_quaternion.csv": lines(
        *("Objects", "100", ",,Global Angle (Quaternion) ada:ada,,,,,,"),
        "Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ",
        *(",,,,,,mm,mm,mm", f"1001,0,{_TURN},1000,2000,100"),
    ),
    "nexus.csv": lines(
        *("", "", "Model Outputs;", "100", ";;a", "Frame;Sub Frame;X", ";;deg", "1;0;5", "", "Trajectories"),
        *("100", ";;ada:top;;;ada:low;;", "Frame;Sub Frame;X;Y;Z;X;Y;Z", ";;mm;mm;mm;mm;mm;mm"),
        *("1001;0;1000,0;2000;100;1;2;3", "1002;0;;;;1;2;3", ""),
    ),
    "qtm_6d.tsv": tabs(
        *(_QTM + "6D", "BODY_NAMES|ada|bob"),
        f"Frame|Time|ada X|Y|Z|Roll|Pitch|Yaw|Residual|{_ROT}|bob X|Y|Z|Roll|Pitch|Yaw|Residual|{_ROT}",
        "1|10.0|1000|2000|100|0|0|90|0.3|0|1|0|-1|0|0|0|0|1" + "|0.0" * 16,
        "2|10.01|1000|2000|100|0|0|90|0.3|0|1|0|-1|0|0|0|0|1|1|1|1|1|1|1|.1|1|0|0|0|1|0|0|0|1",
    ),
    "qtm_3d.tsv": tabs(
        *(_QTM + "3D", "MARKER_NAMES|top|low", "1000.0|2000.0|100.0|1|2|3", "1000.5|2000|100|1|2|3|")
    ),
    "cortex.trc": tabs(
        *("PathFileType|4|(X/Y/Z)|a.trc", "DataRate|CameraRate|NumFrames|NumMarkers|Units", "100|100|2|2|mm"),
        *("Frame#|Time|top|||low|||", "||X1|Y1|Z1|X2|Y2|Z2", "", "1|10.0|1000|2000|100|1|2|3"),
        "2|10.01||||1|2|3",
    ),
}
_AT_S = {"qtm_3d.tsv": 0.0, "rostopic.csv": 1_700_000_010.0, "bagpy.csv": 1_700_000_010.25}
_NAMES = {
    "bodies.csv": ["robot_1", "robot_2"],
    **{
        "motive_1.23.csv": ["ada"],
        "motive_1.25.csv": ["ada"],
        "motive_1.20.csv": ["m"],
        "tracker.csv": ["ada"],
    },
    **{"tracker_quaternion.csv": ["ada"], "nexus.csv": ["ada:top", "ada:low"], "qtm_6d.tsv": ["ada", "bob"]},
    **{"qtm_3d.tsv": ["top", "low"], "cortex.trc": ["top", "low"]},
}
_WANTED = {"pandas.csv": Wanted(units=GivenUnits("s", "m"))}
_POINTS_ONLY = {"motive_1.20.csv", "nexus.csv", "qtm_3d.tsv", "cortex.trc"}


def write(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


@pytest.mark.parametrize("name", _LAYOUTS)
def test_layout_gives_the_known_pose(name: str, tmp_path: Path) -> None:
    found = read_trajectories(write(tmp_path, name, _LAYOUTS[name]), _WANTED.get(name))
    assert [one.name for one in found.trajectories] == _NAMES.get(name, [""])
    first = found.trajectories[0]
    assert first.times_ns[0] == round(_AT_S.get(name, 10.0) * 1000) * 10**6
    np.testing.assert_allclose(first.points_m[0], [1.0, 2.0, 0.1], atol=1e-9)
    turn = [np.nan] * 4 if name in _POINTS_ONLY else np.array([0, 0, 1, 1]) / np.sqrt(2)
    np.testing.assert_allclose(first.quaternions[0], turn, atol=1e-7)
    lost = {"motive_1.23.csv", "tracker.csv", "nexus.csv", "cortex.trc"}
    assert dict(first.left_out).get("without a position", 0) == (name in lost)
    assert [len(line) > 5 for line in found.understood] == [True, True]
    assert found.understood[0].startswith(f"{name}: ")


def write_c3d(path: Path, rows: list[list[tuple[float, float, float, float]]], labels: str) -> Path:
    """Write a C3D file by the bytes of its definition: floats of Intel, in mm, at 100 Hz from frame 11."""
    header = struct.pack("<BBHHHHHfHHf", 2, 80, len(rows[0]), 0, 11, 10 + len(rows), 0, -1.0, 3, 0, 100.0)
    group = struct.pack("<bb5sHB", 5, -1, b"POINT", 3, 0)
    parameters = b""
    for name, kind, sizes, data in (
        (b"UNITS", -1, (2,), b"mm"),
        (b"Y_SCREEN", -1, (2,), b"+Y"),
        (b"LABELS", -1, (4, len(rows[0])), labels.encode()),
        (b"USED", 2, (), struct.pack("<H", len(rows[0]))),
        (b"RATE", 4, (), struct.pack("<f", 100.0)),
        (b"SCALE", 4, (), struct.pack("<f", -1.0)),
        (b"DATA_START", 2, (), struct.pack("<H", 3)),
        (b"FRAMES", 2, (), struct.pack("<H", len(rows))),
    ):
        body = struct.pack(f"<bB{len(sizes)}B", kind, len(sizes), *sizes) + data + b"\0"
        parameters += struct.pack(f"<bb{len(name)}sH", len(name), 1, name, len(body) + 2) + body
    section = struct.pack("<BBBB", 1, 80, 1, 84) + group + parameters
    points = b"".join(struct.pack("<4f", *point) for row in rows for point in row)
    path.write_bytes(header.ljust(512, b"\0") + section.ljust(512, b"\0") + points.ljust(512, b"\0"))
    return path


def test_markers_of_c3d_are_read_with_their_units_and_axes(tmp_path: Path) -> None:
    pytest.importorskip("c3d", reason="the extra mocap is not installed")
    rows = [
        [(1000.0, 100.0, -2000.0, 0.0), (1.0, 2.0, 3.0, 0.0)],
        [(0.0, 0.0, 0.0, -1.0), (1.0, 2.0, 3.0, 0.0)],
    ]
    file = write_c3d(tmp_path / "a.c3d", rows, "top low ")
    found = read_trajectories(file)
    assert [(one.name, one.left_out) for one in found.trajectories] == [
        ("top", (("without a position", 1),)),
        ("low", ()),
    ]
    assert found.trajectories[0].times_ns.tolist() == [100_000_000]
    np.testing.assert_allclose(found.trajectories[0].points_m, [[1.0, 2.0, 0.1]])
    file.write_bytes(file.read_bytes()[:700])
    with pytest.raises(IpsysError, match="has none of its 2 frames"):
        read_trajectories(file)
    file.write_bytes(b"no C3D file")
    with pytest.raises(IpsysError, match="is not a readable C3D file"):
        read_trajectories(file)


def test_marker_beside_a_body_is_offered_by_name(tmp_path: Path) -> None:
    file = write(tmp_path, "motive_1.25.csv", _LAYOUTS["motive_1.25.csv"])
    assert read_trajectories(file).understood[1].endswith("not read, but selectable: ada:1")
    found = read_trajectories(file, Wanted(("ada:1",)))
    assert [one.name for one in found.trajectories] == ["ada", "ada:1"]
    assert found.trajectories[1].points_m.tolist() == [[0.001, -0.001, 0.001]]


def csv_text(*lines: str) -> str:
    return "\n".join(("time_s,robot,x_m,y_m,z_m", *lines))


_UNIT = "\n".join(f"{n / 10},0,0,{np.sin(n / 9)},{np.cos(n / 9)}" for n in range(9))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "is empty"),
        ("a.csv", csv_text(), "has no positions"),
        ("a.csv", csv_text("0,ada,1,nan,0"), "has no positions"),
        ("a.csv", csv_text("0,ada,1,two,0"), "line 2: 'two' is not a number"),
        ("a.csv", csv_text("1e999999999,ada,1,2,0"), "line 2: '1e999999999' is not a time in s"),
        ("a.csv", csv_text("0,ada,1"), "line 2: has 3 cells, but the header has 5"),
        ("a.csv", csv_text("0,,1,2,0"), "line 2: names no robot"),
        ("a.csv", "time_s,robot,x,y,z\n0,ada,1,2,0", "unit of column x is not known.*--length-unit"),
        ("a.csv", "robot,x_m,y_m\nada,1,2", "has no column time.*Candidates: x_m .column 2, 1 to 1"),
        ("a.csv", "time,robot,x_m,y_m,z_m\n0.5,ada,1,2,0", "--time-unit s"),
        ("a.csv", "time_h,x_m,y_m\n0.5,1,2", "has no column time"),
        ("a.csv", "time_s,x_m,y_m,theta\n0,1,2,9\n1,1,2,9", "unit of column theta is not known"),
        ("a.csv", "time_s,a,b,c\n0,1,2,0", "no columns of a position are named.*Candidates: time_s .*, a "),
        ("a.csv", f"time_s,x_m,y_m,z_m,a\n{_UNIT}", "x_m y_m z_m a is a quaternion"),
        ("a.csv", f"time_s,x,y,z,w\n{_UNIT}", "x y z w is a quaternion"),
        ("a.csv", "time_s,x_m,y_m,z_m,x_m,y_m,z_m\n0,1,2,3,4,5,6", "several columns have the same name"),
        ("a.csv", "time_s,x,y,z,w,x,y,z\n0,1,2,3,4,5,6,7", "several columns have the same name"),
        ("a.csv", "0,1,2,3\n1,2,3,4", "has no header, and its numbers do not show its columns"),
        ("a.csv", lines(*(f"{n / 100},1,2,3,.5,.5,.5,.5" for n in range(9))), "do not show its columns"),
        ("a.csv", "0," * 12 + "1", "its numbers do not show its columns"),
        ("a.tum", "0 1 2 3 0 0 0", "line 1: has 7 numbers, not 8"),
        ("a.tum", "0 1 2 3 0 0 0 9", "the quaternion has the length 9"),
        ("a.tum", "# only a comment", "has no positions"),
        ("a.txt", "0 -1 0 1 1 0 0 2 0 0 1 0.1", "KITTI without times"),
        ("a.csv", "Format Version,1.23\n\nFrame,Time\n0,1", "names no rigid bodies or markers"),
        ("a.csv", "Devices\n1000\n\n", "has the sections Devices; export Objects"),
        (
            "a.csv",
            "Objects\n100\n,,a\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,mm,mm,mm,mm,mm,mm\n1,0,0,0,0,1,1,1",
            "the rotation of a has the unit 'mm', not rad or deg",
        ),
        ("a.csv", "Objects\n100\n", "Objects have no rate, names, axes and units"),
        ("a.tsv", "NO_OF_FRAMES\t1\nFREQUENCY\t100\n1\t2\t3", "its head and its columns do not agree"),
        ("a.trc", "PathFileType\t4\t(X/Y/Z)\ta.trc\n", "has no rate, units and names of markers"),
        ("a.xlsx", "", "the format is not known"),
    ],
)
def test_wrong_file_is_refused_in_one_line(name: str, text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(IpsysError, match=message) as refused:
        read_trajectories(write(tmp_path, name, text))
    assert "\n" not in str(refused.value)


def place(x_m: float, turn_rad: float = 0.0) -> dict[str, Any]:
    half = turn_rad / 2
    return {
        "position": {"x": x_m, "y": 2.0, "z": 0.1},
        "orientation": {"z": float(np.sin(half)), "w": float(np.cos(half))},
    }


def moved(x_m: float, y_m: float, turn_rad: float = 0.0) -> dict[str, Any]:
    half = turn_rad / 2
    return {
        "translation": {"x": x_m, "y": y_m},
        "rotation": {"z": float(np.sin(half)), "w": float(np.cos(half))},
    }


def head(time_s: float, frame: str = "odom") -> dict[str, Any]:
    second, rest_ns = divmod(round(time_s * 1000) * 10**6, 10**9)
    return {"stamp": {"sec": second, "nanosec": rest_ns}, "frame_id": frame}


def odometry(time_s: float, x_m: float, covariance: float = 0.0) -> tuple[str, dict[str, Any]]:
    pose = {"pose": place(x_m, np.pi / 2), "covariance": [covariance] * 36}
    return "nav_msgs/msg/Odometry", {"header": head(time_s), "pose": pose}


def stamped(kind: str, time_s: float, x_m: float) -> tuple[str, dict[str, Any]]:
    turn = place(x_m, np.pi / 2)
    if kind == "TransformStamped":
        turn = {"transform": {"translation": turn["position"], "rotation": turn["orientation"]}}
    elif kind == "PoseStamped":
        turn = {"pose": turn}
    else:
        turn = {"pose": {"pose": turn, "covariance": [0.0] * 36}}
    return f"geometry_msgs/msg/{kind}", {"header": head(time_s), **turn}


def transforms(*rows: tuple[str, str, float, dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    values = [
        {"header": head(time_s, parent), "child_frame_id": child, "transform": turn}
        for parent, child, time_s, turn in rows
    ]
    return "tf2_msgs/msg/TFMessage", {"transforms": values}


BagRow = tuple[str, tuple[str, dict[str, Any]]]


def write_bag(kind: str, folder: Path, *rows: BagRow) -> Path:
    """Write a bag: of ROS 1 with bz2 by rosbags, or of ROS 2 in one file by the writer of MCAP."""
    if kind == "mcap":
        path, schemas, store = folder / "drive.mcap", dict[str, Any](), get_typestore(Stores.ROS2_HUMBLE)
        with path.open("wb") as file, McapWriter(file) as ros2:
            for number, (topic, (name, message)) in enumerate(rows):
                text = store.generate_msgdef(name, ros_version=2)[0]
                schemas[name] = schemas.get(name) or ros2.register_msgdef(name, text)
                bag_ns = 1_700_000_005_000_000_000 + number * 10**8
                ros2.write_message(topic, schemas[name], message, bag_ns, bag_ns, number)
        return path
    store, path = message_types(Stores.ROS1_NOETIC), folder / "drive.bag"
    bag = Writer1(path)
    bag.set_compression(bag.CompressionFormat.BZ2)
    with bag:
        topics: dict[str, Any] = {}
        for number, (topic, (name, message)) in enumerate(rows):
            topics[topic] = topics.get(topic) or bag.add_connection(topic, name, typestore=store)
            data = store.serialize_ros1(filled(store, name, message), name)
            bag.write(topics[topic], 1_700_000_005_000_000_000 + number * 10**8, data)
    return path


def filled(store: Any, name: str, values: dict[str, Any]) -> Any:
    """Return a message with the fields of a dict; the others are zero."""
    fields: dict[str, Any] = {}
    for field, (node, about) in store.fielddefs[name][1]:
        value = values.get(field)
        if node.name == "NAME":
            fields[field] = filled(store, about, value or {})
        elif node.name == "BASE":
            fields[field] = ("" if about[0] == "string" else 0) if value is None else value
        elif node.name == "ARRAY":
            fields[field] = np.array([0.0] * about[1] if value is None else value)
        else:
            fields[field] = [filled(store, about[0][1], item) for item in value or []]
    return store.types[name](**fields)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("name", ["PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry"])
def test_topic_of_a_bag_gives_its_poses(name: str, kind: str, tmp_path: Path) -> None:
    make = odometry if name == "Odometry" else partial(stamped, name)
    bag = write_bag(
        kind, tmp_path, ("/pose", make(1_700_000_010.5, 1.0)), ("/pose", make(1_700_000_010.6, 1.1))
    )
    found = read_trajectories(bag)
    (path,) = found.trajectories
    assert (path.name, path.times_ns.tolist()) == (
        "/pose",
        [1_700_000_010_500_000_000, 1_700_000_010_600_000_000],
    )
    np.testing.assert_allclose(path.points_m, [[1, 2, 0.1], [1.1, 2, 0.1]])
    np.testing.assert_allclose(path.quaternions[0], np.array([0, 0, 1, 1]) / np.sqrt(2))
    assert path.covariances is None
    assert found.remarks == ()


def test_covariances_of_odometry_are_those_of_the_bag(tmp_path: Path) -> None:
    bag = write_bag("mcap", tmp_path, ("/odom", odometry(3.0, 1.0, 0.5)), ("/odom", odometry(2.0, 1.0, 0.25)))
    (path,) = read_trajectories(bag).trajectories
    assert path.covariances is not None
    assert path.covariances[:, 5, 4].tolist() == [0.25, 0.5]


def test_zero_stamps_become_times_of_the_bag(tmp_path: Path) -> None:
    bag = write_bag("mcap", tmp_path, ("/odom", odometry(0.0, 1.0)), ("/odom", odometry(0.0, 1.1)))
    found = read_trajectories(bag)
    assert found.trajectories[0].times_ns.tolist() == [1_700_000_005_000_000_000, 1_700_000_005_100_000_000]
    assert "2 messages have no stamp; the times of the bag are used" in found.remarks[0]


def test_several_topics_need_a_selection(tmp_path: Path) -> None:
    rows = [("/a", odometry(1.0, 1.0)), ("/b", stamped("PoseStamped", 1.0, 5.0)), ("/tf", transforms())]
    bag = write_bag("mcap", tmp_path, *rows)
    listed = r"/a \(Odometry, 1\), /b \(PoseStamped, 1\), /tf:PARENT.CHILD"
    with pytest.raises(IpsysError, match=rf"several topics with poses; select one.* {listed}$"):
        read_trajectories(bag)
    with pytest.raises(IpsysError, match=rf"has no topic /c with poses.* {listed}$"):
        read_trajectories(bag, Wanted(("/c",)))
    (path,) = read_trajectories(bag, Wanted(("/b",))).trajectories
    assert (path.name, path.points_m[0, 0]) == ("/b", 5.0)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_frames_are_composed_over_static_and_moving_transforms(kind: str, tmp_path: Path) -> None:
    """The map turns odom by 90 degrees; the camera is 0.5 m before the base."""
    fixed = transforms(*(("base_link", "camera", time_s, moved(0.5, 0.0)) for time_s in (0.0, 11.0)))
    rows: list[BagRow] = [("/tf_static", fixed)]
    rows += [("/tf", transforms(("map", "odom", 10.0 + n, moved(1.0, 2.0, np.pi / 2)))) for n in range(3)]
    rows += [
        ("/tf", transforms(("odom", "base_link", 10.0 + n / 4, moved(n / 4, 0.0, 0.1)))) for n in range(1, 10)
    ]
    bag = write_bag(kind, tmp_path, *rows)
    (path,) = read_trajectories(bag, Wanted(("/tf:map.camera",))).trajectories
    assert path.times_ns[[0, -1]].tolist() == [10_250_000_000, 12_000_000_000]
    ahead = 0.25 + 0.5 * np.cos(0.1), 0.5 * np.sin(0.1)
    np.testing.assert_allclose(path.points_m[0], [1 - ahead[1], 2 + ahead[0], 0.0], atol=1e-12)
    turn_rad = np.pi / 2 + 0.1
    np.testing.assert_allclose(path.quaternions[0], [0, 0, np.sin(turn_rad / 2), np.cos(turn_rad / 2)])
    with pytest.raises(IpsysError, match=r"/tf:world.camera: has no moving transforms.*/tf:map.odom"):
        read_trajectories(bag, Wanted(("/tf:world.camera",)))
    with pytest.raises(IpsysError, match=r"several pairs of frames; select one.*/tf:odom.base_link"):
        read_trajectories(bag)


def test_only_pair_of_frames_needs_no_selection(tmp_path: Path) -> None:
    rows: list[BagRow] = [("/tf", transforms(("odom", "base", 1.0 + n, moved(n, 0.0)))) for n in range(3)]
    (path,) = read_trajectories(write_bag("mcap", tmp_path, *rows)).trajectories
    assert (path.name, path.points_m[:, 0].tolist()) == ("/tf:odom.base", [0.0, 1.0, 2.0])


def test_poses_of_kitti_have_the_times_beside_them(tmp_path: Path) -> None:
    write(tmp_path, "times.txt", "0.5\n1.5e0\n")
    file = write(tmp_path, "00.txt", lines("1 0 0 1 0 1 0 2 0 0 1 3", "0 -1 0 4 1 0 0 5 0 0 1 6"))
    (path,) = read_trajectories(file).trajectories
    assert path.times_ns.tolist() == [500_000_000, 1_500_000_000]
    assert path.points_m.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    np.testing.assert_allclose(path.quaternions[1], np.array([0, 0, 1, 1]) / np.sqrt(2))


def test_tracks_of_another_log_are_read(tmp_path: Path) -> None:
    found = read_trajectories(write_lab(tmp_path / "lab.mcap"))
    assert [one.name for one in found.trajectories] == ["ada", "bob"]
    with Session([tmp_path / "lab.mcap"]) as session:
        first = next(iter(session.payloads(session.topics(TRACKS, "poly"))))
    track = next(track for track in first.tracks if track.robot == "ada")
    assert found.trajectories[0].times_ns[0] == first.timestamp
    assert tuple(found.trajectories[0].points_m[0]) == (track.x_m, track.y_m, track.z_m)
    z, w = found.trajectories[0].quaternions[0, 2:]
    assert track.heading_rad == pytest.approx(2 * np.arctan2(z, w))


def test_bad_rows_are_left_out_and_counted(tmp_path: Path) -> None:
    rows = ["0.2,3,0,0,0,0,0,1", "0.1,2,0,0,0,0,0,2", "0.1,2,0,0,0,0,0,1", "0.1,9,0,0,0,0,0,1"]
    rows += ["0.3,nan,0,0,0,0,0,1", "", "0.4,,,,,,,", "0.5,4,0,0,nan,nan,nan,nan", "0.2,3,0,0,0,0,0,1"]
    rows += ["0.6,0,0,0,0,0,0,0", "nan,,,,,,,"]
    text = "\n".join(["time_s,x_m,y_m,z_m,qx,qy,qz,qw", *rows])
    found = read_trajectories(write(tmp_path, "a.csv", text))
    (path,) = found.trajectories
    assert path.times_ns.tolist() == [100_000_000, 200_000_000, 500_000_000]
    assert path.points_m[:, 0].tolist() == [2, 3, 4]
    assert np.isnan(path.quaternions[:, 0]).tolist() == [True, False, True]
    assert dict(path.left_out) == {
        **{"without a position": 4, "doubled": 2, "with another pose at the same time": 1},
        **{"not in the order of time (sorted)": 4, "without a rotation": 2},
    }
    assert found.remarks[0].startswith("rows: 4 without a position, 2 doubled, 1 with another pose")


def bodies(name: str, *names: str) -> TrajectoryFile:
    rows = np.zeros((1, 3)), np.zeros((1, 4))
    made = tuple(Trajectory(body, np.zeros(1, np.int64), *rows) for body in names)
    return TrajectoryFile(Path(name), made, ("", ""))


@pytest.mark.parametrize(
    ("files", "robots", "known", "expected"),
    [
        ([["ada", "bob"]], [], "ada bob", "ada:ada bob:bob"),
        ([["b1", "b2"]], ["ada=b2"], "ada bob", "ada:b2"),
        ([["b1", "b2"]], ["ada", "bob"], "ada bob", "ada:b1 bob:b2"),
        ([["b1", "bob"]], ["ada=b1"], "ada bob", "ada:b1 bob:bob"),
        ([[""], [""]], ["bob", "ada"], "ada bob", "bob: ada:"),
        ([["drone"]], [], "ada", "ada:drone"),
        ([["eve"]], [], "ada bob", "error: 'eve' is not known; the rig has ada, bob; .* --robot ada=eve"),
        ([["marker_7"]], [], "", "marker_7:marker_7"),
        ([[""]], [], "ada bob", "error: names no robot; add --robot NAME"),
        ([["b1", "b2"]], ["ada"], "ada bob", "error: 'b1' is not known; .* --robot ada=b1 .bodies: b1, b2"),
        ([["b1", "b2"]], ["ada=b3"], "ada bob", "error: has no body 'b3' for --robot ada; bodies: b1, b2"),
        ([["ada"], ["ada"]], [], "ada bob", "error: robot 'ada' has a path already"),
        ([["ada"]], ["bob"], "ada bob", "error: --robot bob: no file is left for it"),
    ],
)
def test_bodies_are_assigned_to_robots(
    files: list[list[str]], robots: list[str], known: str, expected: str
) -> None:
    read = [bodies(f"{number}.csv", *names) for number, names in enumerate(files)]
    if expected.startswith("error: "):
        with pytest.raises(IpsysError, match=expected.removeprefix("error: ")):
            assign_robots(read, robots, known.split())
        return
    sources = {id(one.times_ns): one.name for file in read for one in file.trajectories}
    found = assign_robots(read, robots, known.split())
    assert " ".join(f"{one.name}:{sources[id(one.times_ns)]}" for one in found) == expected


@pytest.fixture
def cases() -> Path:
    folder = Path(os.environ.get("IPSYS_CASES", ROOT / "../shared/cases")).resolve()
    if not (folder / "truth").is_dir():
        pytest.skip(f"no ground truth of other systems in {folder}: set IPSYS_CASES")
    return folder


@pytest.mark.parametrize(
    "name",
    [
        *("body_turned", "cm", "euroc", "excel_de", "headerless", "lost_nan", "motive", "ms", "names"),
        *("qualisys", "quat_nan", "quoted_comma", "semicolon", "tab"),
    ],
)
def test_case_of_ground_truth_is_the_same_path(name: str, cases: Path) -> None:
    """Each file states the path of good.csv; the one of Qualisys counts from its first frame."""
    (file,) = (cases / "truth").glob(f"{name}.*sv")
    found, good = read_trajectories(file), read_trajectories(cases / "truth" / "good.csv")
    for one, known in zip(found.trajectories, good.trajectories, strict=False):
        start_ns = known.times_ns[0] if name == "qualisys" else 0
        rows = np.searchsorted(known.times_ns + 6_000_000, one.times_ns + start_ns)
        np.testing.assert_allclose(one.points_m, known.points_m[rows], atol=2e-6)


def test_bag_of_the_case_has_the_path_of_its_tum_file(cases: Path) -> None:
    (bag,) = read_trajectories(cases / "trajectories" / "odombag_lever").trajectories
    (tum,) = read_trajectories(cases / "trajectories" / "odom_lever.tum").trajectories
    np.testing.assert_allclose(bag.times_ns - tum.times_ns, 0, atol=500)
    np.testing.assert_allclose(bag.points_m, tum.points_m, atol=1e-12)
    np.testing.assert_allclose(bag.quaternions, tum.quaternions, atol=1e-9)


def test_quaternion_with_the_names_of_a_position_is_none(cases: Path) -> None:
    file = cases / "trajectories" / "motive_dupcols.csv"
    with pytest.raises(IpsysError, match="unit of column x is not known"):
        read_trajectories(file)
    (path,) = read_trajectories(file, Wanted(units=GivenUnits(length="m"))).trajectories
    np.testing.assert_allclose(path.points_m[0], [-1.424464, 0.229415, -0.102270])
    np.testing.assert_allclose(path.quaternions[0], [0.023043, -0.999286, 0.004426, 0.029620], atol=1e-5)
