"""Measuring on a finished log: measurements reach the model, and withdrawn ones do not count."""

import fcntl
import io
import os
import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from ipsys_log.app.cli.dialog import ask_places
from ipsys_log.engine.request import Request
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.live_runs.survey.checks import check_entry, withdrawal_of
from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry
from ipsys_log.live_runs.survey.from_log import open_finished_log
from ipsys_log.live_runs.survey.scene import observe_marker
from ipsys_log.log.dataset import Session
from ipsys_log.messages import MEASUREMENTS_TOPIC, Measurement, Pair
from ipsys_log.messages.channels import MEASUREMENTS, MODEL
from ipsys_log.statistics.calibration_points import ENOUGH_POINTS, active_measurements
from tests.changed_logs import rewrite
from tests.conftest import Ipsys, Unmeasured, data_section
from tests.test_bad_input import refused


def as_typed(measurement: Measurement) -> TypedEntry:
    """Return a measurement as typed text, to a tenth of a millimetre."""
    distances = {d.reference: f"{100 * d.distance_m:.2f}" for d in measurement.distances}
    height = f"{100 * (measurement.height_m or 0):.2f}"
    split = " ".join(measurement.splits)
    return TypedEntry(str(measurement.marker_id), distances, measurement.side or "", height, split)


def sheet(path: Path, tape: Iterable[Measurement], **columns: list[str]) -> Path:
    """Write a sheet of these measurements."""
    rows = [",".join(["marker", "d_A_cm", "d_B_cm", "side", "height_cm", "split", *columns])]
    for n, one in enumerate(map(as_typed, tape)):
        cells = [one.marker, one.distances["A"], one.distances["B"], one.side, one.height, one.split]
        rows.append(",".join([*cells, *(values[n] for values in columns.values())]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def times(tape: Iterable[Measurement], log: Path) -> list[str]:
    with Session([log]) as session:
        return [f"{(one.timestamp - session.start_ns) / 1e9:.3f}" for one in tape]


class Row(NamedTuple):
    log_time_ns: int
    id: str
    withdraws: str


def foreign_read(path: Path) -> list[Row]:
    """Return the measurements as read by the ``mcap`` package and protobuf, with the schema in the log."""
    rows = []
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages(topics=[MEASUREMENTS_TOPIC]):
            assert schema is not None
            pool = DescriptorPool()
            for one in FileDescriptorSet.FromString(schema.data).file:
                pool.Add(one)
            kind: Any = GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found = kind.FromString(message.data)
            rows.append(Row(message.log_time, found.id, found.withdraws))
    return rows


def pairs_of(log: Path) -> dict[tuple[str, int, tuple[float, ...]], Pair]:
    """Return the observations of each camera at each point, by camera, marker and camera point in nm."""
    with Session([log]) as session:
        model = session.payloads(session.topics(MODEL, "poly"))[-1]
    return {
        (camera.camera, pair.marker_id, tuple((pair.camera_m * 1e9).round())): pair
        for camera in model.cameras
        for pair in camera.pairs
    }


def test_points_measured_later_give_the_pairs_of_a_live_session(
    ipsys: Ipsys, unmeasured: Unmeasured, replayed_log: Path, tmp_path: Path
) -> None:
    # Markers outside the images, or in only one image, are not known to be stationary.
    theirs = {key: pair for key, pair in pairs_of(replayed_log).items() if pair.frames > 1}
    seen = {pair.measurement for pair in theirs.values()}
    log, tape = unmeasured
    tape = [one for one in tape if one.id in seen]
    before = data_section(log)
    path = sheet(tmp_path / "a.csv", tape, time=times(tape, log))
    # One point is so near to B that its distance may be in metres; no other is doubtful.
    (doubt,) = refused(ipsys, log, "measure", log, "--csv", path).splitlines()[1:]
    assert "d_B_cm: 8.15 cm is very short; if it is in metres, type 815" in doubt
    done = ipsys("measure", log, "--csv", path, "--force")
    assert done.code == 0, done.err
    assert f"{len(tape)} points measured into {log}" in done.out
    assert done.err.splitlines()[-1] == f"next: ipsys calibrate-lab {log}"
    assert data_section(log).startswith(before)
    assert ipsys("fit", log, "--model", "poly").code == 0
    mine = pairs_of(log)
    assert theirs.keys() <= mine.keys()
    assert len(theirs) > 40
    for key, pair in theirs.items():
        # Values are to a tenth of a millimetre; flat circles amplify this up to four times.
        assert np.allclose(mine[key].world_m, pair.world_m, atol=0.0003), key


def fitted_ids(log: Path, run: str) -> set[str]:
    with Session([log]) as session:
        model = session.payloads(session.topics(MODEL, run))[-1]
    return {pair.measurement for camera in model.cameras for pair in camera.pairs}


def test_fit_uses_a_measured_point_and_ignores_a_withdrawn_one(ipsys: Ipsys, unmeasured: Unmeasured) -> None:
    log, tape = unmeasured
    with open_finished_log(log, Request()) as scene:
        for one in tape[8:20]:
            (stop,) = (n for n, stop in enumerate(scene.intervals) if stop.covers(one))
            typed = as_typed(one)
            sight = observe_marker(scene.views(stop), int(typed.marker))
            history = scene.history()
            checked = check_entry(*parse_entry(typed, scene.rig), scene.rig, sight, history, scene.model)
            assert checked.measurement is not None, checked.faults
            scene.add([checked.measurement])
        assert ipsys("replay", log, "--model", "rigid").code == 0
        gone = min(fitted_ids(log, "rigid"))
        scene.add([withdrawal_of(scene.history(), gone)])
        with pytest.raises(IpsysError, match=f"measurement {gone} cannot be withdrawn"):
            withdrawal_of(scene.history(), gone)
    assert ipsys("replay", log, "--model", "rigid").code == 0
    assert fitted_ids(log, "rigid") - fitted_ids(log, "rigid_2") == {gone}
    rows = foreign_read(log)
    assert [row.id for row in rows if row.withdraws] == [f"{gone}_withdrawn"]
    at = {row.id: row.log_time_ns for row in rows}
    assert at[f"{gone}_withdrawn"] > at["p003"]


def test_sheet_rows_match_intervals_by_order_or_by_number(
    ipsys: Ipsys, unmeasured: Unmeasured, tmp_path: Path
) -> None:
    log, tape = unmeasured
    mine = [one for one in tape if one.marker_id == 3]
    done = ipsys("measure", log, "--csv", sheet(tmp_path / "a.csv", mine))
    assert done.code == 0
    listed = ipsys("measure", log, "--places")
    assert f"p{len(mine):03d}" in listed.out
    assert f"calibration points in the log: {len(mine)}; enough: {ENOUGH_POINTS}" in done.err
    assert f"next: ipsys calibrate-lab {log}" in done.err
    other = [one for one in tape if one.marker_id == 4][:2]
    with open_finished_log(log, Request()) as scene:
        numbers = [str(next(n for n, s in enumerate(scene.intervals, 1) if s.covers(one))) for one in other]
    assert ipsys("measure", log, "--csv", sheet(tmp_path / "b.csv", other, place=numbers)).code == 0
    with Session([log]) as session:
        found = session.payloads([MEASUREMENTS_TOPIC])
    by_time = sorted([*mine, *other], key=lambda m: (m.timestamp, m.marker_id))
    assert [(m.marker_id, m.side) for m in sorted(found, key=lambda m: (m.timestamp, m.marker_id))] == [
        (m.marker_id, m.side) for m in by_time
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "marker,d_A_cm,d_B_cm,side,height_cm\n0,100,40,left,0\n",
            ["line 2: d_A_cm = 100 cm and d_B_cm = 40 cm do not meet, because A to B is 243.8 cm"],
        ),
        (
            "marker,d_A_cm,d_B_cm,side,height_cm,place\n0,1.7,190,left,0,1\n\n99,170,190,left,0,1\n0,170,x,up,,1\n",
            [
                "cm do not meet, because A to B is",
                "line 4: marker 99 is not in the rig",
                "line 5: d_B_cm: 'x' is not a number",
                "line 5: side 'up'",
                "line 5: height_cm? 0 if",
            ],
        ),
        (
            "marker;d_A_cm;d_B_cm;side;height_cm;place\n0;170,5;190;left;0;999\n",
            ["line 2: place 999 is not between 1 and"],
        ),
        ("marker,d_A_cm,d_B_cm,side,height_cm,time\n0,170,190,left,0,noon\n", ["line 2: time 'noon'"]),
        (
            "marker,d_A_cm,d_B_cm,side,height_cm\n0,170,190,left,0,7\n",
            ["line 2: the row has 6 cells, but the header has 5"],
        ),
        (
            "marker,d_A_cm,d_B_cm,side,height_cm\n0,170,190,left,0,20\n0,170,190,up,10\n",
            [
                "line 2: the row has 6 cells, but the header has 5; if it has a decimal comma, write a "
                "point: 212.7",
                "line 3: side 'up': write left or right",
            ],
        ),
        (
            "marker,d_A_cm,d_B_cm,side,height_cm,place,note\n0,170,5,190,left,20\n",
            ["line 2: side '190': write left or right; if it has a decimal comma, write a point: 212.7"],
        ),
        ("marker,d_A_cm,side,height_cm\n0,170,left,0\n", ["line 1: the column d_A_cm is missing"]),
        ("marker,d_A_m,d_B_cm,side,height_cm\n0,1.7,190,left,0\n", ["line 1: unknown column 'd_A_m'"]),
        ("marker,d_A_cm,d_B_cm,side,height_cm\n0,170,190,left,0\n", ["rows without place and time"]),
        ("marker,d_A_cm,d_B_cm,side,height_cm\n", ["has no measurements"]),
        ("", ["line 1: the column marker is missing"]),
    ],
)
def test_a_bad_sheet_changes_nothing_and_names_its_rows(
    ipsys: Ipsys, unmeasured: Unmeasured, text: str, said: list[str]
) -> None:
    path = unmeasured.log.with_name("sheet.csv")
    path.write_text(text)
    lines = refused(ipsys, unmeasured.log, "measure", unmeasured.log, "--csv", path).splitlines()
    for part in said:
        assert sum(part in line for line in lines) == 1


def test_locked_missing_or_read_only_log_is_refused(ipsys: Ipsys, unmeasured: Unmeasured) -> None:
    log = unmeasured.log
    with log.open("r+b") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert "another process is writing it" in refused(ipsys, log, "measure", log, "--places")
    assert "does not exist" in refused(ipsys, log, "measure", log.with_name("none.mcap"))
    if os.geteuid() != 0:
        log.chmod(0o400)
        assert "cannot be opened for writing" in refused(ipsys, log, "measure", log)


def test_two_processes_measure_in_one_log(unmeasured: Unmeasured) -> None:
    log, tape = unmeasured
    with open_finished_log(log, Request()) as one, open_finished_log(log, Request()) as other:
        one.add([Measurement(tape[0].timestamp, "p001", marker_id=0)])
        with pytest.raises(LogError, match="another program wrote measurements into this log"):
            other.add([Measurement(tape[0].timestamp, "p001", marker_id=0)])
        # The second process now sees the first one's entry: it continues after it, and they alternate.
        assert [m.id for m in other.history()] == ["p001"]
        other.add([Measurement(tape[0].timestamp, "p002", marker_id=0)])
        with pytest.raises(LogError, match=r"into this log \(p002\); check them, and save again"):
            one.add([withdrawal_of(one.history(), "p001")])
        one.add([withdrawal_of(one.history(), "p001")])
        with pytest.raises(LogError, match="p001_withdrawn"):
            other.add([Measurement(tape[0].timestamp, "p003", marker_id=0)])
        assert [m.id for m in active_measurements(other.history())] == ["p002"]
    assert [row.id for row in foreign_read(log)] == ["p001", "p002", "p001_withdrawn"]


def test_missing_or_bad_sheet_is_reported_before_detection(ipsys: Ipsys, lab: Path) -> None:
    line = refused(ipsys, lab, "measure", lab, "--csv", lab.with_name("none.csv"))
    assert "none.csv: cannot be read: No such file or directory" in line
    path = lab.with_name("sheet.csv")
    path.write_text("marker;d_A;d_B\n")
    assert "line 1: unknown column 'd_A'" in refused(ipsys, lab, "measure", lab, "--csv", path)


def test_log_without_stationary_intervals_is_refused(ipsys: Ipsys, lab: Path) -> None:
    with Session([lab]) as session:
        start_ns = session.start_ns
    log = rewrite(lab, lambda m: m if m.log_time_ns <= start_ns + 1_050_000_000 else None)
    done = ipsys("measure", log)
    assert done.code == 1
    assert "no marker of the rig is stationary" in done.err


def test_the_terminal_asks_checks_and_undoes(
    ipsys: Ipsys, unmeasured: Unmeasured, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, tape = unmeasured
    with open_finished_log(log, Request()) as scene:
        first = as_typed(next(one for one in tape if scene.intervals[0].covers(one)))
    a, b = first.distances.values()
    answers = [a, "1.234", b, first.side[0], first.height, "", "u", "q"]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(answers) + "\n"))
    done = ipsys("measure", log, "--terminal")
    assert done.code == 0, done.err
    assert "distance to B: 1.234 cm looks like metres" in done.out
    assert "p001 is in the log" in done.out
    assert "p001 is withdrawn" in done.out
    assert "1 point measured" in done.out
    assert [row.withdraws for row in foreign_read(log)] == ["", "p001"]
    # withdrawn at the question for point 2, and back at point 1
    places = re.findall(r"Stationary interval (\d+) of", done.out)
    assert places == ["1", "2", "1"]


def test_bad_answer_in_the_terminal_is_asked_again(
    unmeasured: Unmeasured, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log, tape = unmeasured
    with open_finished_log(log, Request()) as scene:
        first = as_typed(next(one for one in tape if scene.intervals[0].covers(one)))
        a, b = first.distances.values()
        script = [
            ("distance to A", "hallo"), ("distance to A", f"{a} cm"),
            ("distance to B", "1.234"), ("distance to B", "3"),  # possibly metres: asked again
            ("distance to B", ""),
            ("distance to A", ""), ("distance to B", b),  # no triangle: Enter keeps the good values
            ("left or right", "up"), ("left or right", {"left": "links", "right": "Rechts"}[first.side]),
            ("height", "0,15"), ("height", "x"), ("height", first.height),
            ("save p001", "perhaps"), ("save p001", "n"),
            ("distance to A", ""), ("distance to B", ""), ("left or right", ""), ("height", ""),
            ("save p001", "y"), ("distance to A", "q"),
        ]  # fmt: skip
        left = iter(script)

        def prompt(question: str, default: str, **_: object) -> str:
            wanted, given = next(left)
            assert wanted in question
            return given or default

        monkeypatch.setattr("typer.prompt", prompt)
        ask_places(scene)
        assert next(left, None) is None
    said = " ".join(capsys.readouterr().out.split())
    for text in (
        "distance to A: 'hallo' is not a number",
        "3 cm is very short; if it is in metres, type 300",
        "cm do not meet, because",
        "'up' is not a side; type l or r",
        "0,15 cm looks like metres; type 15",
        "'perhaps' is not yes or no; type y or n",
        "p001 is in the log",
    ):
        assert text in said
    assert said.count("a: start the point again") == 1
    with Session([log]) as session:
        (saved,) = session.payloads(session.topics(MEASUREMENTS))
    assert as_typed(saved).distances == first.distances


def test_terminal_entry_allows_a_second_process_to_measure(
    unmeasured: Unmeasured, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log, tape = unmeasured
    with open_finished_log(log, Request()) as scene, open_finished_log(log, Request()) as other:
        first = as_typed(next(one for one in tape if scene.intervals[0].covers(one)))
        a, b = first.distances.values()
        answers = iter([a, b, first.side[0], first.height, "y", "y", "q"])

        def prompt(*_: object, **__: object) -> str:
            answer = next(answers)
            if answer == first.height:
                other.add([Measurement(tape[0].timestamp + 10**9, "p001", marker_id=1)])
            return answer

        monkeypatch.setattr("typer.prompt", prompt)
        ask_places(scene)
    said = capsys.readouterr().out
    assert "another program wrote measurements into this log (p001)" in said
    assert "p002 is in the log" in said
    assert sorted(row.id for row in foreign_read(log)) == ["p001", "p002"]


def test_the_page_is_served_until_it_is_interrupted(unmeasured: Unmeasured) -> None:
    command = [sys.executable, "-m", "ipsys_log", "measure", str(unmeasured.log), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        assert served.stderr is not None
        url = served.stdout.readline().removeprefix("open ").strip()
        with urllib.request.urlopen(url, timeout=240) as page:
            assert "<title>ipsys measure</title>" in page.read().decode()
        served.send_signal(signal.SIGINT)
        out, err = served.communicate(timeout=240)
    assert served.returncode == 0
    assert out == f"0 points measured into {unmeasured.log}\n"
    assert "Traceback" not in err
