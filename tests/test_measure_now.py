"""``ipsys record --measure --points-only``: the remaining data of a session, for every end."""

import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Measurement, Message
from ipsys_log.messages.channels import MEASUREMENTS
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys, Unmeasured
from tests.test_measure import foreign_read
from tests.tiers import first_fast
from tests.waiting import wait_until

PATIENCE_S = 240.0
RATE_HZ = 10
HEAD = ("record", "--measure", "--points-only", "--port", "0", "--rig")


class Lab(NamedTuple):
    """Return a rig whose cameras send a minute of one station, and its tape measurement."""

    rig: Path
    lenses: Path
    tape: list[Measurement]


@pytest.fixture(scope="session")
def still_lab(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Lab:
    folder = tmp_path_factory.mktemp("still")
    with Session([lab_log]) as session:
        start_ns = session.start_ns
        tape = [
            m for m in session.payloads(session.topics(MEASUREMENTS)) if m.timestamp < start_ns + 2 * 10**9
        ]
        shown = {name: session.payloads([topic])[:2] for name, topic in session.images.items()}
        lines = ['name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2']
        lines += [f"[[markers]]\nid = {n}" for n in range(8)]
        (rig,) = session.payloads(["/rig"])
        lines += [
            f'[[reference_points]]\nname = "{p.name}"\nx_m = {p.x_m}\ny_m = {p.y_m}'
            for p in rig.reference_points
        ]

        def messages() -> Iterator[Message]:
            for n in range(600):
                for camera, payloads in sorted(shown.items()):
                    time_ns = start_ns + n * NS_PER_S // RATE_HZ
                    image: CompressedImage = replace(payloads[n % 2], timestamp=time_ns)
                    yield Message(session.images[camera], time_ns, time_ns, image, camera)

        write_log(folder / "still.mcap", messages())
        lines += [
            f'[[cameras]]\nname = "{c}"\nsource = "file:{folder}/still.mcap?{c}"' for c in sorted(shown)
        ]
    (folder / "lab.toml").write_text("\n".join(lines))
    return Lab(folder / "lab.toml", lab_log, tape)


class Page:
    """The requests of the page, without a browser."""

    def __init__(self, url: str) -> None:
        self._url = url

    def ask(self, path: str, body: dict[str, Any] | None = None) -> dict[str, Any]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._url + "api/" + path, data, {"X-Ipsys": "1"})
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
                found: dict[str, Any] = json.load(answer)
        except urllib.error.HTTPError as error:
            found = json.load(error)
        return found

    def measure(self, one: Measurement) -> dict[str, Any]:
        """Save a point as soon as its marker is stationary, in spite of warnings."""
        body: dict[str, Any] = {
            "marker": str(one.marker_id),
            "distances": {d.reference: f"{100 * d.distance_m:.2f}" for d in one.distances},
            "side": one.side,
            "height": f"{100 * (one.height_m or 0):.2f}",
        }
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            body["accepted"] = self.ask("check", body).get("warnings", [])
            saved = self.ask("measure", body)
            if "saved" in saved:
                return saved
            time.sleep(0.1)
        raise AssertionError(saved)


@contextmanager
def measuring(lab: Lab, log: Path) -> Iterator[tuple[subprocess.Popen[str], Page]]:
    """Run the command with its page; the cameras were checked for a second."""
    command = [*HEAD, lab.rig, "--calibration", lab.lenses, "-o", log]
    with subprocess.Popen(
        [sys.executable, "-m", "ipsys_log", *map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stderr is not None
        said = ""
        while "measure at " not in said:
            line = program.stderr.readline()
            assert line, said
            said += line
        page = Page(said.rpartition("measure at ")[2].strip())
        wait_until(lambda: len(page.ask("views")["visible"]) >= 3, "three markers are visible")
        time.sleep(1.2)
        yield program, page
        if program.poll() is None:
            program.kill()


def counted(log: Path) -> dict[str, int]:
    with Session([log]) as session:
        return {name: session.count(topic) for name, topic in session.images.items()}


# Six points in real time.
@pytest.mark.slow
@pytest.mark.parametrize("number", first_fast(1, [signal.SIGINT, signal.SIGTERM]))
def test_page_measures_points_until_it_is_stopped(
    number: int, ipsys: Ipsys, still_lab: Lab, tmp_path: Path
) -> None:
    log = tmp_path / "places.mcap"
    with measuring(still_lab, log) as (program, page):
        begun_s = time.monotonic()
        for one in still_lab.tape[:6]:
            page.measure(one)
        measured_s = time.monotonic() - begun_s
        assert page.ask("undo", {"id": "p002"})["withdrawn"] == "p002"
        time.sleep(3)  # without kept data
        program.send_signal(number)
        out, err = program.communicate(timeout=PATIENCE_S)
    assert program.returncode == 0, err
    assert "Traceback" not in err
    assert f"6 points measured into {log}, 1 withdrawn" in out
    assert [row.withdraws for row in foreign_read(log)] == [""] * 6 + ["p002"]
    for name, count in counted(log).items():
        # from one second before the first point, and until the last one
        assert 7 < count < RATE_HZ * (measured_s + 2), name
    listed = ipsys("measure", log, "--places")
    assert all(f"p00{n}" in listed.out for n in (1, 3, 4, 5, 6))


@pytest.mark.slow
def test_measured_points_survive_a_kill(ipsys: Ipsys, still_lab: Lab, tmp_path: Path) -> None:
    log = tmp_path / "places.mcap"
    with measuring(still_lab, log) as (program, page):
        page.measure(still_lab.tape[0])
        time.sleep(0.5)
        program.kill()
        program.communicate(timeout=PATIENCE_S)
    assert "ipsys repair" in ipsys("info", log).err
    assert ipsys("repair", log).code == 0
    assert [row.id for row in foreign_read(log)] == ["p001"]
    with Session([log]) as session:
        (one,) = session.payloads(session.topics(MEASUREMENTS))
        assert one.still is not None
        for topic in session.images.values():
            times_ns = [m.publish_time_ns for m in session.messages([topic])]
            inside = [t for t in times_ns if one.still.start <= t <= one.still.end]
            assert len(inside) > 5


def typed(command: list[str], answers: list[tuple[str, str]]) -> tuple[int, str]:
    """Run a command in a terminal, and answer its questions; return exit code and output."""
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-m", "ipsys_log", *command])
    told, seen = "", 0
    left, end = list(answers), time.monotonic() + PATIENCE_S
    while True:
        if not select.select([terminal], [], [], max(end - time.monotonic(), 0))[0]:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise AssertionError(f"nothing more after {told}")
        try:
            data = os.read(terminal, 1 << 16)
        except OSError:  # the command has ended
            break
        told += data.decode(errors="replace")
        if left and left[0][0] in told[seen:]:
            seen = len(told)
            answer = left.pop(0)[1]
            if answer == "SIGTERM":
                os.kill(child, signal.SIGTERM)
            else:
                os.write(terminal, answer.encode())
    os.close(terminal)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), told


@pytest.mark.slow
@pytest.mark.parametrize("end", first_fast(2, ["q\n", "\x03", "SIGTERM"]))
def test_points_are_measured_in_the_terminal(end: str, still_lab: Lab, tmp_path: Path) -> None:
    log, one = tmp_path / "places.mcap", still_lab.tape[0]
    a, b = (f"{100 * d.distance_m:.2f}" for d in one.distances)
    command = [*HEAD, str(still_lab.rig), "--terminal", "-o", str(log)]
    answers = [
        ("marker", "99\n"), ("not in the rig", f"{one.marker_id}\n"),
        ("distance to A", f"{a}\n"), ("distance to B", f"{b}\n"),
        ("left or right", f"{one.side}\n"), ("height", f"{100 * (one.height_m or 0):.2f}\n"), ("save", "y\n"),
        ("is in the log", "u\n"), ("is withdrawn", end),
    ]  # fmt: skip
    code, told = typed([*command, "--calibration", str(still_lab.lenses)], answers)
    assert code == 0, told
    assert "Traceback" not in told
    assert "1 point measured into" in told
    assert [row.withdraws for row in foreign_read(log)] == ["", "p001"]
    assert all(5 < count < 40 for count in counted(log).values())


def test_sheet_faults_are_on_separate_lines(unmeasured: Unmeasured) -> None:
    sheet = unmeasured.log.with_name("sheet.csv")
    sheet.write_text("marker,d_A_cm,d_B_cm,side,height_cm\n0,100,40,left,0\n99,170,190,left,0\n")
    code, told = typed(["measure", str(unmeasured.log), "--csv", str(sheet)], [])
    assert code == 1
    lines = told.replace("\r", "").rstrip("\n").split("\n")
    assert max(len(line) for line in lines if str(sheet) not in line) <= 80
    assert [line.split(": ")[0] for line in lines if line.startswith("  line ")] == [
        "  line 2",
        "  line 3",
    ], lines
    # A message that is longer than the window continues below it.
    assert any("d_B_cm" in line and line.startswith("  ") for line in lines)
