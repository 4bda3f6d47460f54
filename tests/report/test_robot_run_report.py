"""Tables, JSON and page of a robot run whose errors follow from its messages by hand."""

import base64
import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from ipsys_log.app.report.robot_run import render_robot_run, robot_run_json, robot_run_tables
from ipsys_log.engine.output import write_log
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    COMMANDS_TOPIC,
    DRIVING,
    FINISHED,
    HOLDING,
    PATHS_TOPIC,
    RIG_TOPIC,
    STOPPED,
    TRUTH_TOPIC,
    CompressedImage,
    Marker,
    Markers,
    Message,
    RigMarker,
    RobotPath,
    Track,
    Tracks,
    Waypoint,
    WheelCommand,
)
from ipsys_log.tools.robot_run import read_robot_run
from tests.labs import RIG
from tests.stages.drawing import VGA

S = 1_000_000_000
P1, P2 = Waypoint(1.0, 1.0), Waypoint(2.0, 1.0)
# State, waypoint, true x in m and received x in m, for each half second of the cart's drive.
DRIVE: list[tuple[str, int, float, float | None]] = [
    (STOPPED, 1, 0.9, None),
    (DRIVING, 1, 0.9, 0.91),
    (HOLDING, 1, 1.0, 1.01),
    (HOLDING, 1, 1.0, 1.01),
    (DRIVING, 2, 1.3, 1.31),
    (STOPPED, 2, 1.4, None),
    (STOPPED, 2, 1.4, None),
    (DRIVING, 2, 1.7, 1.71),
    (FINISHED, 2, 1.995, 2.005),
]


def half_second(step: int) -> int:
    return S + step * S // 2


def at(topic: str, time_ns: int, payload: object, name: str | None = None) -> Message:
    return Message(topic, time_ns + 1, time_ns, payload, name)


def cart_messages() -> Iterator[Message]:
    """Yield the drive of one robot, with images of one camera and a frame that has no marker."""
    received: tuple[float, int] | None = None
    for step, (state, waypoint, true_m, received_m) in enumerate(DRIVE):
        time_ns = half_second(step)
        pose = Track("cart", 4, true_m, 1.0, 0.0)
        yield at(TRUTH_TOPIC, time_ns, Tracks(time_ns, (pose,)))
        if received_m is not None:
            received = received_m, time_ns
            yield at("/runs/poly/tracks", time_ns, Tracks(time_ns, (replace(pose, x_m=received_m),)))
        command = WheelCommand(time_ns, "cart", 0.1, 0.1, state, waypoint)
        if received is not None:
            command = replace(command, x_m=received[0], y_m=1.0, position_time=received[1])
        yield at(COMMANDS_TOPIC, time_ns, command)
        if step < 2:  # a camera without intrinsics, which then sends nothing more
            small = cv2.imencode(".jpg", np.zeros((90, 160, 3), dtype=np.uint8))[1].tobytes()
            frame = CompressedImage(time_ns, "blue", small, "jpeg")
            yield at("/cameras/blue/image", time_ns, frame, "blue")
        grey = cv2.imencode(".jpg", np.full((480, 640, 3), 90, dtype=np.uint8))[1].tobytes()
        yield at("/cameras/red/image", time_ns, CompressedImage(time_ns, "red", grey, "jpeg"), "red")
        corners = np.array([[300, 100], [320, 100], [320, 120], [300, 120]], dtype=np.float64)
        markers = (Marker(4, corners),) if step % 2 else ()
        yield at("/runs/edges/cameras/red/markers", time_ns, Markers(time_ns, markers, 640, 480), "red")


def run_messages(others: int = 1) -> Iterator[Message]:
    """Yield the drive of the cart, and of ``others`` robots that get no position."""
    vans = [f"van_{number}" for number in range(others)]
    rig = replace(
        RIG, markers=(RigMarker(4, robot="cart"), *(RigMarker(5 + n, robot=v) for n, v in enumerate(vans)))
    )
    yield at(RIG_TOPIC, 1, rig)
    yield at("/cameras/red/calibration", 1, replace(VGA, frame_id="red"), "red")
    yield at(PATHS_TOPIC, 2, RobotPath(2, "cart", (P1, P2)))
    for van in vans:
        yield at(PATHS_TOPIC, 2, RobotPath(2, van, (P1, P2)))
    for message in cart_messages():
        yield message
        if message.topic == COMMANDS_TOPIC:
            for van in vans:
                command = WheelCommand(message.publish_time_ns, van, 0.0, 0.0, STOPPED, 1)
                yield replace(message, payload=command)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write_log(tmp_path / "run.mcap", run_messages())
    return tmp_path / "run.mcap"


def test_errors_are_those_of_the_messages(log: Path) -> None:
    with Session([log]) as session:
        result = robot_run_json(read_robot_run(session))
    cart, van = result["robots"]
    assert (result["duration_s"], result["nearest_m"]) == (4.0, None)
    assert (cart["finished"], van["finished"]) == (True, False)
    first, second = cart["waypoints"]
    assert [(row["number"], row["x_m"], row["arrival_s"]) for row in (first, second)] == [
        (1, 1.0, 1.0),
        (2, 2.0, 4.0),
    ]
    assert [row["control_m"] for row in (first, second)] == pytest.approx([0.01, 0.005])
    assert [row["true"]["median_m"] for row in (first, second)] == pytest.approx([0.0, 0.005])
    assert first["positioning"]["poly"]["max_m"] == pytest.approx(0.01)
    assert cart["positioning"]["poly"]["count"] == 6
    (stop,) = cart["stops"]
    # The last position is that of 1.3 m, half a second before the stop; half a second later the robot stands.
    assert (stop["start_s"], stop["end_s"], stop["age_s"]) == (2.5, 3.0, 0.5)
    assert (stop["braking_m"], stop["moved_m"]) == pytest.approx((0.1, 0.0))
    assert (van["waypoints"], van["stops"], van["positioning"]) == ([], [], {})


def test_tables_show_centimetres_and_the_unfinished_robot(log: Path) -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    with Session([log]) as session:
        console.print(robot_run_tables(read_robot_run(session)))
    text = console.export_text()
    assert re.search(r"P1 \(1, 1\) +1\.0 s +1\.00 +0\.00 0\.00 0\.00 +1\.00\n", text)
    assert re.search(r"P2 \(2, 1\) +4\.0 s +0\.50 +0\.50 0\.50 0\.50 +1\.00\n", text)
    assert "cart: stopped from 2.5 to 3.0 s, 0.50 s after its last position; it moved 10.0 cm" in " ".join(
        text.split()
    )
    assert "van_0 reached 0 of 2 waypoints" in text
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.slow
def test_page_has_panels_also_of_a_robot_that_never_moves(log: Path) -> None:
    with Session([log]) as session:
        page, panels = render_robot_run(session)
    assert "cart: 2 of 2 waypoints" in page
    assert "van_0: 0 of 2 waypoints" in page
    images = [base64.b64decode(data) for data in re.findall(r"data:image/png;base64,([A-Za-z0-9+/=]+)", page)]
    assert images[0] == panels
    assert len(images) == 2
    assert all(cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_COLOR) is not None for one in images)


def test_robots_without_truth_and_without_model(tmp_path: Path) -> None:
    def without(message: Message) -> bool:
        return message.topic not in (TRUTH_TOPIC, "/runs/poly/tracks")

    write_log(tmp_path / "bare.mcap", filter(without, run_messages(0)))
    with Session([tmp_path / "bare.mcap"]) as session:
        result = robot_run_json(read_robot_run(session))
    (cart,) = result["robots"]
    assert [row["true"] for row in cart["waypoints"]] == [None, None]
    assert [row["control_m"] for row in cart["waypoints"]] == pytest.approx([0.01, 0.005])
    assert [(stop["age_s"], stop["braking_m"]) for stop in cart["stops"]] == [(0.5, None)]
    json.dumps(result)


def test_distance_of_two_robots_is_between_equal_instants(tmp_path: Path) -> None:
    log = tmp_path / "two.mcap"
    first = Tracks(S, (Track("cart", 4, 1.0, 1.0, 0.0), Track("van_0", 5, 1.0, 3.0, 0.0)))
    later = Tracks(2 * S, (Track("cart", 4, 1.0, 1.5, 0.0), Track("van_0", 5, 1.0, 3.0, 0.0)))
    alone = Tracks(3 * S, (Track("cart", 4, 1.0, 3.0, 0.0),))
    paths = [m for m in run_messages() if m.topic in (RIG_TOPIC, PATHS_TOPIC, COMMANDS_TOPIC)]
    write_log(log, [*paths, *(at(TRUTH_TOPIC, one.timestamp, one) for one in (first, later, alone))])
    with Session([log]) as session:
        assert read_robot_run(session).nearest_m == pytest.approx(1.5)


def test_log_without_a_robot_run_names_the_command(tmp_path: Path) -> None:
    write_log(tmp_path / "empty.mcap", [at(RIG_TOPIC, 1, RIG)])
    with (
        Session([tmp_path / "empty.mcap"]) as session,
        pytest.raises(IpsysError, match="'ipsys drive' makes one"),
    ):
        read_robot_run(session)
