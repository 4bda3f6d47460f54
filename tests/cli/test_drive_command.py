"""Wrong input of ``ipsys drive`` gives one line: the fault, its place, and the remedy."""

from pathlib import Path

import pytest

from ipsys_log.live_runs.robot_runs.settings import PROGRAM
from ipsys_log.log.dataset import Session
from tests.conftest import Ipsys

REFUSED = {
    ("--robots", "9"): "--robots 9: give 1 to 3",
    (
        "--path",
        "eve=1,1 2,2",
    ): "--path eve=1,1 2,2: no robot eve; write ROBOT=X,Y X,Y ... with one of robot_0",
    ("--path", "robot_0=1,1"): "--path robot_0=1,1: a path has at least two waypoints",
    ("--path", "robot_0=1 2"): '--path robot_0=1 2: write ROBOT=X,Y X,Y in m, as "robot_0=0.5,0.5 2,1"',
    ("--path", "robot_0=1,1 nan,2"): "--path robot_0=1,1 nan,2: write ROBOT=X,Y X,Y in m, as "
    '"robot_0=0.5,0.5 2,1"',
    ("--path", "robot_0=1,1 5,1"): "--path robot_0: waypoint 5,1 is outside the lab; x and y are from 0 to "
    "4.88 m",
    (
        "--path",
        "robot_0=1,1 0.01,1",
    ): "--path robot_0: waypoint 0.01,1 is in no image; choose a place farther from the walls",
    ("--fail", "blue=5:2"): "--fail blue: the lab has no camera of this name; it has red, white, black",
    ("--fail", "red"): "--fail red: write CAMERA=START:SECONDS, such as white=20:5",
    ("--fail", "red=0:2"): "--fail red=0:2: a camera must send for 1 s first; give a later start",
    ("--over", "natnet"): "--over natnet: is no stream of robots; use udp, vrpn or ros2",
    ("--over", "vrpn", "--loss", "0.1"): "--loss and --delay-ms need --over udp or --over ros2: VRPN has no "
    "relay",
    ("--loss", "1.5"): "--loss 1.5: give a share from 0 to below 1, such as 0.05",
    ("--delay-ms", "-1"): "--delay-ms -1: give a delay from 0 to 10000 ms",
    ("--program", "none.py"): "--program none.py: does not exist; name the program of the robots, or leave "
    "--program out for the example of ipsys",
}


@pytest.mark.parametrize("options", REFUSED, ids=" ".join)
def test_wrong_option_is_refused(
    options: tuple[str, ...], replayed_log: Path, ipsys: Ipsys, tmp_path: Path
) -> None:
    program = () if "--program" in options else ("--program", PROGRAM)
    target = tmp_path / "run.mcap"
    done = ipsys("drive", "--model-from", replayed_log, "-o", target, "--port", "0", *program, *options)
    assert (done.code, done.err) == (1, f"ipsys: {REFUSED[options]}\n")
    assert not target.exists()


def test_log_of_another_lab_is_refused(replayed_log: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    options = ("--model-from", replayed_log, "-o", tmp_path / "run.mcap", "--lab-seed", "3")
    done = ipsys("drive", *options, "--program", PROGRAM)
    expected = (
        f"ipsys: --model-from {replayed_log}: is not a log of the simulated lab with seed 3; give the seed "
        "of its 'ipsys simulate' with --lab-seed, or make one: ipsys simulate -o cal.mcap --seed 3; ipsys "
        "replay cal.mcap\n"
    )
    assert (done.code, done.err) == (1, expected)


def test_log_without_intrinsics_is_refused(calibration: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    done = ipsys("drive", "--model-from", calibration, "-o", tmp_path / "run.mcap", "--program", PROGRAM)
    expected = (
        f"ipsys: --model-from {calibration}: has no camera intrinsics; give the log of the simulated lab, "
        "with its model in it: ipsys replay LOG, without -o\n"
    )
    assert (done.code, done.err) == (1, expected)


def test_log_without_model_is_refused(lab_log: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    done = ipsys("drive", "--model-from", lab_log, "-o", tmp_path / "run.mcap", "--program", PROGRAM)
    assert done.code == 1
    assert done.err.startswith(f"ipsys: {lab_log}: ")
    assert "model" in done.err
    assert done.err.count("\n") == 1


def test_program_that_ends_is_named(replayed_log: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    program = tmp_path / "robot.py"
    program.write_text("raise SystemExit(3)")
    options = ("--model-from", replayed_log, "-o", tmp_path / "run.mcap", "--port", "0", "--lockstep")
    done = ipsys("drive", *options, "--program", program)
    expected = f"robot_0: its program {program} has ended with exit code 3; its messages are above\n"
    assert (done.code, done.err.splitlines(keepends=True)[-1]) == (1, f"ipsys: {expected}")


@pytest.mark.slow
def test_program_that_ends_later_keeps_the_log(replayed_log: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    program, target = tmp_path / "robot.py", tmp_path / "run.mcap"
    # It answers eight ticks and ends.
    program.write_text(
        "import json, socket, sys\n"
        "robot, wheels = sys.argv[2], sys.argv[6].split(':')\n"
        "link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n"
        "link.connect((wheels[0], int(wheels[1])))\n"
        "link.send(json.dumps({'robot': robot}).encode())\n"
        "for _ in range(8):\n"
        "    tick = json.loads(link.recv(2048))['tick']\n"
        "    command = {'robot': robot, 'tick': tick, 'left_m_s': 0.1, 'right_m_s': 0.1}\n"
        "    link.send(json.dumps(command).encode())\n"
    )
    options = ("--model-from", replayed_log, "-o", target, "--port", "0", "--lockstep")
    done = ipsys("drive", *options, "--program", program)
    expected = f"robot_0: its program {program} has ended with exit code 0; its messages are above\n"
    assert (done.code, done.err.splitlines(keepends=True)[-1]) == (1, f"ipsys: {expected}")
    with Session([target]) as session:
        assert [command.left_m_s for command in session.payloads(["/robots/commands"])] == [0.1] * 8
    assert ipsys("verify", target).code == 0
