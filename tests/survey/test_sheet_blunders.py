"""Doubtful rows of a sheet: named with their contradiction, and written only on request."""

import io
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.engine.request import Request
from ipsys_log.live_runs.survey.entry import TypedEntry
from ipsys_log.live_runs.survey.from_log import open_finished_log
from ipsys_log.live_runs.survey.sheet import name_columns
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Measurement, Rig
from ipsys_log.messages.channels import MEASUREMENTS
from ipsys_log.statistics.calibration_points import active_measurements
from tests import labs
from tests.conftest import Ipsys, Unmeasured
from tests.survey.test_checks import THREE, check, tape
from tests.test_bad_input import refused
from tests.test_measure import foreign_read, sheet, times


def swap_distances(one: Measurement) -> Measurement:
    """Return the measurement with the distances to A and B exchanged."""
    a, b = one.distances
    return replace(one, distances=(replace(a, distance_m=b.distance_m), replace(b, distance_m=a.distance_m)))


def swap_rows(tape: Sequence[Measurement], first: int, second: int) -> list[Measurement]:
    """Return the measurements with the readings of two of them exchanged."""
    rows = [*tape]
    for number, other in ((first, tape[second]), (second, tape[first])):
        rows[number] = replace(
            tape[number], distances=other.distances, side=other.side, height_m=other.height_m
        )
    return rows


def lies_far_from_b(one: Measurement) -> bool:
    """Return False for a distance that may be read as metres."""
    return min(distance.distance_m for distance in one.distances) > 0.1


@pytest.fixture
def with_model(ipsys: Ipsys, unmeasured: Unmeasured, detected_lab: Path) -> Unmeasured:
    """Return a session without measurements, with the model of another log of the same cameras."""
    assert ipsys("fit", detected_lab, "--model", "rigid").code == 0
    assert ipsys("fit", unmeasured.log, "--model-from", detected_lab, "--model", "rigid").code == 0
    return unmeasured


def cm_away(line: str) -> float:
    """Return the contradiction in a line, in cm."""
    stated = re.search(r"(\d+) cm away", line)
    assert stated is not None, line
    return float(stated[1])


def test_sheet_row_with_swapped_distances_is_refused(ipsys: Ipsys, with_model: Unmeasured) -> None:
    log, tape = with_model
    good, wrong = tape[0], swap_distances(tape[1])
    path = sheet(log.with_name("sheet.csv"), [good, wrong], time=times([good, wrong], log))
    first, line = refused(ipsys, log, "measure", log, "--csv", path).splitlines()
    assert "nothing was written" in first
    assert "--force" in first
    assert line.startswith("  line 3: ")
    assert "d_A_cm and d_B_cm look exchanged" in line
    # Exchanged distances mirror a point on the perpendicular bisector of A and B.
    assert cm_away(line) == pytest.approx(100 * mirrored_m(tape[1]), abs=5)


def mirrored_m(one: Measurement) -> float:
    """Return the distance between two points with exchanged distances to A and B, in closed form."""
    a_m, b_m = (distance.distance_m for distance in one.distances)
    return float(abs(a_m**2 - b_m**2) / np.hypot(*(labs.B - labs.A)))


def test_sheet_row_that_looks_wrong_is_written_with_force(ipsys: Ipsys, with_model: Unmeasured) -> None:
    log, tape = with_model
    rows = [tape[0], swap_distances(tape[1])]
    path = sheet(log.with_name("sheet.csv"), rows, time=times(rows, log))
    done = ipsys("measure", log, "--csv", path, "--force")
    assert done.code == 0, done.err
    assert "line 3: p002: the point is" in done.err
    assert [row.id for row in foreign_read(log)] == ["p001", "p002"]
    # The page also asks about a point that is already measured.
    again = [replace(tape[0], height_m=(tape[0].height_m or 0) + 0.01)]
    lines = refused(
        ipsys, log, "measure", log, "--csv", sheet(path, again, time=times(again, log))
    ).splitlines()
    assert "line 2: marker" in lines[1]
    assert "is already measured here, as p001 (1.0 cm from here)" in lines[1]


def test_sheet_with_bad_and_doubtful_rows_names_both(ipsys: Ipsys, with_model: Unmeasured) -> None:
    log, tape = with_model
    rows = [tape[0], swap_distances(tape[1])]
    path = sheet(log.with_name("sheet.csv"), rows, time=["900", *times(rows[1:], log)])
    text = refused(ipsys, log, "measure", log, "--csv", path)
    assert text.index("line 2: marker 0 is not stationary") < text.index("line 3: the point")
    assert "--force" not in text
    # An impossible row is refused even on request.
    assert "line 2: marker 0" in refused(ipsys, log, "measure", log, "--csv", path, "--force")


@pytest.mark.parametrize("model", [True, False])
def test_sheet_with_two_rows_swapped_names_both_rows(
    ipsys: Ipsys, unmeasured: Unmeasured, calibration: Path, model: bool
) -> None:
    log, tape = unmeasured
    if model:
        assert ipsys("fit", log, "--model-from", calibration).code == 0
    with open_finished_log(log, Request()) as scene:
        stops = scene.intervals
    seen = [one for one in tape if lies_far_from_b(one) and any(stop.covers(one) for stop in stops)]
    first, second = 3, 17
    wrong = swap_rows(seen, first, second)
    path = sheet(log.with_name("sheet.csv"), wrong, time=times(wrong, log))
    lines = refused(ipsys, log, "measure", log, "--csv", path).splitlines()[1:]
    assert [line.split(":")[0].strip() for line in lines] == [f"line {first + 2}", f"line {second + 2}"]
    judge = "the model" if model else "the other rows"
    assert all(f"the prediction of {judge}" in line for line in lines)
    assert f"its numbers fit line {second + 2} (marker {seen[second].marker_id})" in lines[0]
    assert f"its numbers fit line {first + 2} (marker {seen[first].marker_id})" in lines[1]


@pytest.mark.parametrize(
    ("typed", "rig", "column"),
    [
        (tape((1.0, 4.0, 0.0), distances={"A": "3", "B": "243"}), labs.RIG, "d_A_cm"),
        (tape((1.0, 4.0, 0.0), height="0.5"), labs.RIG, "height_cm"),
        (tape((1.0, 4.0, 0.0), height="180"), labs.RIG, "height_cm"),
        (tape((1.0, 5.1, 0.0)), labs.RIG, "d_A_cm and d_B_cm"),
        (tape((2.0, 2.6, 0.0)), labs.RIG, "d_A_cm and d_B_cm"),
        (
            tape((1.0, 4.0, 0.0), THREE, distances={"A": "157.7", "B": "308.1", "C": "400"}),
            THREE,
            "d_A_cm, d_B_cm and d_C_cm contradict each other by",
        ),
    ],
)
def test_doubt_about_a_row_names_its_column(typed: TypedEntry, rig: Rig, column: str) -> None:
    (text,) = check(typed, rig).warnings
    assert column in name_columns(text, rig)


def test_undo_in_the_terminal_asks_for_older_points(
    ipsys: Ipsys, unmeasured: Unmeasured, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, tape = unmeasured
    rows = [one for one in tape if lies_far_from_b(one)][:2]
    assert (
        ipsys("measure", log, "--csv", sheet(log.with_name("a.csv"), rows, time=times(rows, log))).code == 0
    )

    def session(*answers: str) -> str:
        monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(answers) + "\n"))
        done = ipsys("measure", log, "--terminal")
        assert done.code == 0, done.err
        return " ".join(done.out.split())

    def left() -> list[str]:
        with Session([log]) as log_now:
            return [m.id for m in active_measurements(log_now.payloads(log_now.topics(MEASUREMENTS)))]

    said = session("u", "", "q")
    assert "is of an earlier one. Withdraw it? [y/N]" in said
    assert "no measurement is withdrawn" in said
    session("u", "q", "q")
    assert left() == ["p001", "p002"]
    session("u", "y", "q")
    assert left() == ["p001"]
