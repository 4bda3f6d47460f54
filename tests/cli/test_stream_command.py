"""``ipsys stream`` and the streams of ``ipsys live``: sockets, keys of the terminal, and refusals."""

import json
import os
import pty
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import termios
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import ipsys_log
from ipsys_log.app.cli.stream import press, read_keys
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Rig, RigMarker, RigStream
from ipsys_log.messages.channels import RIG, TRACKS
from ipsys_log.messages.rig_file import load_rig, rig_toml
from tests.conftest import Ipsys
from tests.ports import free_port
from tests.sinks.open_sockets import exposed, open_sockets
from tests.sinks.streaming import RIG as LAB
from tests.sinks.streaming import START_NS, STEP_NS, in_order, write_tracks
from tests.test_bad_input import refused

_LIMIT_S = 240.0


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_tracks(tmp_path / "x.mcap")


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(_LIMIT_S)
        yield sock


def port_of(sock: socket.socket) -> int:
    port: int = sock.getsockname()[1]
    return port


def started(*arguments: object, stdin: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "ipsys_log", *map(str, arguments)]
    return subprocess.Popen(command, stdin=stdin, stderr=subprocess.PIPE, text=True)


def stop(program: subprocess.Popen[str]) -> str:
    program.send_signal(signal.SIGINT)
    _, text = program.communicate(timeout=_LIMIT_S)
    assert program.returncode == 0, text
    return text


def test_stream_sends_a_log_and_ends(ipsys: Ipsys, log: Path, listening: socket.socket) -> None:
    done = ipsys("stream", log, "--udp", port_of(listening), "--rate", 20, "--robot", "bob")
    assert (done.code, done.out) == (0, "")
    assert done.err.splitlines() == [f"UDP {port_of(listening)}: only this machine", "playing poly: 2.0 s"]
    poses = [json.loads(listening.recv(2048)) for _ in range(50)]
    assert {pose["robot"] for pose in poses} == {"bob"}
    assert poses[-1]["time_ns"] == START_NS + 49 * STEP_NS


@pytest.mark.parametrize("host", [None, "0.0.0.0"])
def test_no_socket_is_open_beyond_loopback_without_host(
    log: Path, listening: socket.socket, host: str | None
) -> None:
    options = ["--udp", f"127.0.0.1:{port_of(listening)}", "--udp", "239.255.0.1:9870", "--loop"]
    options += ["--mavlink", "ada=127.0.0.1:9"]
    ports = [free_port() for _ in range(3)]
    for name, port in zip(("vrpn", "ros2", "foxglove"), ports, strict=True):
        options += [f"--{name}-port", str(port)]
    program = started("stream", log, *options, *(["--host", host] if host else []))
    try:
        listening.recv(2048)
        opened = open_sockets(program.pid)
        assert {port for *_, port in opened} >= set(ports)
        assert len(opened) == 7
        addresses = {address for address, port in listening_sockets() if port in ports}
        assert addresses == ({host} if host else {"127.0.0.1"})
        assert bool(exposed(program.pid)) is (host is not None)
    finally:
        text = stop(program)
    assert ("every computer of this network" in text) is (host is not None)


@pytest.mark.slow
def test_rerun_page_is_for_this_machine_only_and_ends(log: Path, listening: socket.socket) -> None:
    pytest.importorskip("rerun")
    program = started("stream", log, "--rerun", "--udp", port_of(listening), "--loop")
    assert program.stderr is not None
    try:
        line = next(line for line in program.stderr if line.startswith("Rerun"))
        listening.recv(2048)
        page, data = map(int, re.findall("(?::|%3A)([0-9]+)", line))
        with urllib.request.urlopen(f"http://127.0.0.1:{page}/", timeout=_LIMIT_S) as answer:
            assert b"Rerun" in answer.read()
        servers = [row for row in listening_sockets() if row[1] in (page, data)]
        assert sorted(servers) == sorted([("127.0.0.1", page), ("127.0.0.1", data)])
    finally:
        stop(program)
    assert not [row for row in listening_sockets() if row[1] in (page, data)]


def listening_sockets() -> list[tuple[str, int]]:
    """Return address and port of all listening sockets of TCP, from ``ss``."""
    if shutil.which("ss") is None:
        pytest.skip("ss is not installed")
    text = subprocess.run(["ss", "-Hlnt"], capture_output=True, text=True, check=True).stdout
    addresses = (line.split()[3].rpartition(":") for line in text.splitlines())
    return [(address.strip("[]"), int(port)) for address, _, port in addresses]


def test_keys_of_the_terminal_control_the_player(log: Path, listening: socket.socket) -> None:
    terminal, theirs = pty.openpty()
    options = ["--udp", port_of(listening), "--start-paused"]
    program = started("stream", log, *options, stdin=theirs)
    assert program.stderr is not None
    try:
        for _ in range(3):  # until the keys are read
            line = program.stderr.readline()
            if line.startswith("playing"):
                break
        os.write(terminal, b".")
        first = [json.loads(listening.recv(2048)) for _ in range(2)]
        assert [(pose["time_ns"] - START_NS, pose["robot"]) for pose in first] == [(0, "ada"), (0, "bob")]
        assert select.select([listening], [], [], 0.3)[0] == []  # it is still paused
        os.write(terminal, b"\x1b[C")  # beyond the end: the last position
        os.write(terminal, b".")
        last = json.loads(listening.recv(2048))
        assert last["time_ns"] == START_NS + 49 * STEP_NS
        assert last["session"] > first[0]["session"]
        os.write(terminal, b"q")
        program.communicate(timeout=_LIMIT_S)
        assert program.returncode == 0
    finally:
        program.kill()
        program.communicate()
        os.close(terminal)
        os.close(theirs)


def test_keys_change_rate_pause_and_loop(log: Path) -> None:
    with ipsys_log.play(log, start_paused=True) as player:
        rates = []
        for key in "++++-----------":
            press(player, key)
            rates.append(player.rate)
        assert (rates[:5], rates[-2:]) == ([2.0, 5.0, 10.0, 10.0, 5.0], [0.1, 0.1])
        states = []
        for key in (" ", " ", "l", "l", "x", "."):
            press(player, key)
            states.append((player.is_paused, player.loop))
        assert states == [
            *((False, False), (True, False), (True, True), (True, False), (True, False)),
            (True, False),
        ]


def test_background_job_leaves_the_terminal_alone(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, theirs = pty.openpty()
    with os.fdopen(theirs) as stdin, ipsys_log.play(log, start_paused=True) as player:
        monkeypatch.setattr(sys, "stdin", stdin)
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
        before = termios.tcgetattr(stdin)
        with read_keys(player, print):
            assert termios.tcgetattr(stdin) == before
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
        with read_keys(player, print):
            assert termios.tcgetattr(stdin) != before
        assert termios.tcgetattr(stdin) == before
    os.close(terminal)


def test_streams_of_a_rig_file_are_opened_and_those_of_a_log_are_not(
    ipsys: Ipsys, tmp_path: Path, listening: socket.socket
) -> None:
    rig = replace(LAB, stream=RigStream(udp=(f"127.0.0.1:{port_of(listening)}",), robots=("ada",)))
    log = write_tracks(tmp_path / "x.mcap", 3, rig=rig)
    line = refused(ipsys, log, "stream", log)
    assert "no stream is given" in line
    (tmp_path / "lab.toml").write_text(rig_toml(rig))
    assert ipsys("stream", log, "--rig", tmp_path / "lab.toml", "--rate", 50).code == 0
    assert [json.loads(listening.recv(2048))["robot"] for _ in range(3)] == ["ada"] * 3
    with Session([log]) as session:
        (logged,) = session.payloads(session.topics(RIG))
    assert logged.stream == rig.stream
    assert ipsys("init", tmp_path / "new.toml", "--from", log).code == 0
    assert load_rig(tmp_path / "new.toml").stream is None


REFUSED = {
    "--udp 10.0.0.1:9870": "is another machine",
    "--udp 9870 --robot eve": "robot 'eve' is not known; the rig has ada, bob",
    "--udp 9870 --key none.key": "none.key: does not exist; to make it: openssl rand -hex 32",
    "--udp 9870 --key short.key": "short.key: has 5 bytes; write 16 to 4096",
    "--udp 9870 --rate 0": "rate 0: give a number from 0.01 to 100",
    "--udp 9870 --restamp later": "--restamp later: is not known; use original or now",
    "--udp 9870 --run best": "run 'best' has no tracks; poly has",
    "--udp 9870 --topics /nothing": "--topics /nothing: the log has no such topic",
    "--udp 9870 --topics /rig": "name one topic with tracks: /runs/poly/tracks",
    "--udp 9870 --start-offset 7": "start offset 7 s: the log ends after 1.960 s",
    "--udp 9870 --start-offset -1": "start offset -1.0 s: give a time of at least 0 s",
    "--mavlink 127.0.0.1:9870": "--mavlink 127.0.0.1:9870: write ROBOT=HOST:PORT",
    "--mavlink eve=9870": "robot 'eve' is not known; the rig has ada, bob",
    "--host 0.0.0.0": "--host: has no effect without a stream",
    "--robot ada": "--robot: has no effect without a stream",
    "--ros2-domain 0": "--ros2-domain: has no effect without a stream",
    "--udp 9870 --ros2-domain 0": "--ros2-domain: has no effect without ROS 2; add --ros2",
    "--udp 9870 --images": "--images: has no effect without a viewer; add --foxglove or --rerun",
    "--ros2 --ros2-domain 300": "--ros2-domain 300: give a domain ID from 0 to 232",
    "--ros2 --robot eve": "robot 'eve' is not known; the rig has ada, bob",
    "--foxglove --host 192.0.2.77": "--host 192.0.2.77: is not an address of this machine",
}


@pytest.mark.parametrize("options", REFUSED)
def test_wrong_options_are_refused_in_one_line(
    ipsys: Ipsys, log: Path, options: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(log.parent)
    Path("short.key").write_text("short")
    assert REFUSED[options] in refused(ipsys, log, "stream", log, *options.split())


def test_log_without_tracks_names_the_command(ipsys: Ipsys, lab: Path) -> None:
    line = refused(ipsys, lab, "stream", lab, "--udp", "9870")
    assert f"{lab}: has no tracks to play; to make them: ipsys replay {lab}" in line


def test_ground_truth_of_a_simulated_lab_can_be_played(
    ipsys: Ipsys, lab: Path, listening: socket.socket
) -> None:
    options = ["--topics", "/truth/tracks", "--rate", "100", "--start-offset", "20"]
    done = ipsys("stream", lab, "--udp", port_of(listening), *options)
    assert done.code == 0, done.err
    assert "playing ground truth" in done.err
    assert json.loads(listening.recv(2048))["robot"]


Change = Callable[[Rig], Rig]
WRONG_RIGS: dict[str, tuple[Change, str]] = {
    "port": (lambda rig: replace(rig, stream=RigStream(vrpn=0)), "[stream]: vrpn is 0; give a port"),
    "ros2": (lambda rig: replace(rig, stream=RigStream(ros2=70000)), "[stream]: ros2 is 70000; give a port"),
    "foxglove": (
        lambda rig: replace(rig, stream=RigStream(foxglove=0)),
        "[stream]: foxglove is 0; give a port",
    ),
    "robot": (lambda rig: replace(rig, stream=RigStream(robots=("eve",))), "robot 'eve' is not known"),
    "time": (lambda rig: replace(rig, stream=RigStream(stale_s=-1.0)), "stale_s is -1; give a time"),
    "no robots": (
        lambda rig: replace(rig, markers=(), stream=RigStream(robots=("ada",))),
        "the rig names none: use marker_<id>",
    ),
}


@pytest.mark.parametrize("name", WRONG_RIGS)
def test_wrong_stream_of_a_rig_file_is_refused(ipsys: Ipsys, log: Path, name: str) -> None:
    change, text = WRONG_RIGS[name]
    path = log.with_name("lab.toml")
    path.write_text(rig_toml(change(LAB)))
    assert text in refused(ipsys, log, "stream", log, "--udp", "9870", "--rig", path)


def test_stream_key_of_a_rig_must_be_a_list(ipsys: Ipsys, log: Path) -> None:
    path = log.with_name("lab.toml")
    path.write_text(rig_toml(LAB) + '\n[stream]\nudp = "127.0.0.1:9870"\n')
    line = refused(ipsys, log, "stream", log, "--rig", path)
    assert 'udp must be a list of texts, such as ["a", "b"]' in line


SIMULATED = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
reference_points = [{ name = "A", x_m = 0.0, y_m = 0.0 }, { name = "B", x_m = 4.88, y_m = 0.0 }]
"""
CAMERA = '[[cameras]]\nname = "{0}"\nsource = "sim:{0}?stations=0"\nwidth = 480\nheight = 270\nrate_hz = 5\n'


@pytest.mark.slow
def test_live_positions_are_streamed_and_recorded(
    ipsys: Ipsys, tmp_path: Path, calibration: Path, listening: socket.socket
) -> None:
    rig, log = tmp_path / "lab.toml", tmp_path / "live.mcap"
    rig.write_text(SIMULATED + "".join(CAMERA.format(name) for name in ("red", "white")))
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    options = ["--model-from", calibration, "--rig", rig, "-o", log, "--seconds", 4]
    done = ipsys("live", *options, "--udp", port_of(listening))
    assert done.code == 0, done.err
    assert f"UDP {port_of(listening)}: only this machine" in done.err
    assert "names no robots; the streams name them marker_<id>" in done.err
    with Session([log]) as session:
        recorded = session.payloads(session.topics(TRACKS, "poly"))
    listening.settimeout(0.2)
    poses = []
    while True:
        try:
            poses.append(json.loads(listening.recv(4096)))
        except TimeoutError:
            break
    assert poses
    assert {pose["time_ns"] for pose in poses} <= {row.timestamp for row in recorded}
    assert [(pose["robot"], pose["x_m"]) for pose in poses] == [
        (track.robot, round(track.x_m, 6)) for track in in_order(recorded)
    ]
    assert all(pose["age_s"] > 0 for pose in poses)


def test_live_loop_of_python_opens_the_streams_of_its_rig(
    tmp_path: Path, calibration: Path, listening: socket.socket
) -> None:
    rig, log = tmp_path / "lab.toml", tmp_path / "live.mcap"
    stream = f'[stream]\nudp = ["127.0.0.1:{port_of(listening)}"]\n'
    rig.write_text(SIMULATED + "".join(CAMERA.format(name) for name in ("red", "white")) + stream)
    lines: list[str] = []
    with ipsys_log.live(rig, record=log, model_from=calibration, say=lines.append) as tracker:
        assert next(iter(tracker)).tracks
        pose = json.loads(listening.recv(4096))
        assert (pose["robot"].startswith("marker_"), "late" in pose) == (True, True)
        assert tracker.state is not None
    assert f"UDP 127.0.0.1:{port_of(listening)}: only this machine" in lines


def test_log_of_a_rig_without_robots_gives_a_remark(
    ipsys: Ipsys, tmp_path: Path, listening: socket.socket
) -> None:
    log = write_tracks(tmp_path / "x.mcap", 3, rig=replace(LAB, markers=()))
    done = ipsys("stream", log, "--udp", port_of(listening), "--rate", 50)
    assert (done.code, "the rig names no robots; the streams name them marker_<id>" in done.err) == (0, True)


def test_live_refuses_a_stream_before_it_opens_a_camera(
    ipsys: Ipsys, tmp_path: Path, calibration: Path
) -> None:
    rig = tmp_path / "lab.toml"
    rig.write_text(SIMULATED + "".join(CAMERA.format(name) for name in ("red", "white")))
    begin_s = time.monotonic()
    done = ipsys(
        *("live", "--model-from", calibration, "--rig", rig, "-o", tmp_path / "x.mcap", "--udp", "10.0.0.1:9")
    )
    assert (done.code, "is another machine" in done.err) == (1, True)
    assert not (tmp_path / "x.mcap").exists()
    assert time.monotonic() - begin_s < _LIMIT_S


def test_rig_with_a_stream_reads_back(tmp_path: Path) -> None:
    stream = RigStream("10.0.0.1", ("a:1", "b:2"), "udp.key", 3883, ("ada",), 0.3, (), 0.0, 7447, 3, 8765)
    rig = replace(LAB, stream=stream, markers=(RigMarker(0, robot="ada"),))
    path = tmp_path / "lab.toml"
    path.write_text(rig_toml(rig))
    assert load_rig(path) == rig
