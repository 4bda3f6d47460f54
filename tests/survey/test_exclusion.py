"""Exclusion of calibration points: what the stages read, and what the log then says."""

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.engine.output import write_log
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.from_log import exclude
from ipsys_log.log.codec import decode, encode, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Evaluation, Measurement, Message, Model
from ipsys_log.messages.channels import EVALUATION, MEASUREMENTS, MODEL
from ipsys_log.statistics.calibration_points import active_measurements, withdrawals
from ipsys_log.tools.soundness.check import check_logs
from tests.conftest import Ipsys, data_section


@pytest.fixture(scope="module")
def fitted_log(detected_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the small simulated session with a rigid model and its evaluation."""
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.pipeline import replay

    log = tmp_path_factory.mktemp("fitted") / "lab.mcap"
    shutil.copy(detected_log, log)
    replay([log], Request(models=("rigid",)), "evaluate")
    return log


@pytest.fixture
def fitted(fitted_log: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(fitted_log, tmp_path / "lab.mcap"))


def measured(log: Path) -> list[Measurement]:
    with Session([log]) as session:
        return session.payloads(session.topics(MEASUREMENTS))


def model_bytes(log: Path, run: str) -> bytes:
    with Session([log]) as session:
        ((_, data),) = session.stored(session.topics(MODEL, run))
    return data


def used_ids(log: Path, run: str) -> set[str]:
    with Session([log]) as session:
        (model,) = session.payloads(session.topics(MODEL, run))
    assert isinstance(model, Model)
    return {pair.measurement for camera in model.cameras for pair in camera.pairs}


def evaluation(log: Path, run: str) -> Evaluation:
    with Session([log]) as session:
        (payload,) = session.payloads(session.topics(EVALUATION, run))
    assert isinstance(payload, Evaluation)
    return payload


def test_fit_after_exclusion_and_readmission_is_equal(ipsys: Ipsys, fitted: Path) -> None:
    before = data_section(fitted)
    gone = sorted(used_ids(fitted, "rigid"))[0]
    done = ipsys("exclude", fitted, gone, "--reason", "the tape sagged")
    assert done.code == 0, done.err
    assert done.out.startswith(f"excluded: {gone}; calibration points in use: ")
    assert data_section(fitted).startswith(before)
    assert ipsys("evaluate", fitted, "--model", "rigid").code == 0
    assert used_ids(fitted, "rigid") - used_ids(fitted, "rigid_2") == {gone}
    assert encode(evaluation(fitted, "rigid_2")) != encode(evaluation(fitted, "rigid"))
    assert ipsys("exclude", fitted, gone, "--readmit", "--reason", "it was straight").code == 0
    assert ipsys("evaluate", fitted, "--model", "rigid").code == 0
    assert model_bytes(fitted, "rigid_3") == model_bytes(fitted, "rigid")
    assert encode(evaluation(fitted, "rigid_3")) == encode(evaluation(fitted, "rigid"))
    messages = [m for m in measured(fitted) if not m.is_point]
    assert [(m.withdraws, m.readmits, m.reason) for m in messages] == [
        (gone, None, "the tape sagged"),
        (None, gone, "it was straight"),
    ]
    (result,) = check_logs([fitted])
    assert not [finding for finding in result.remarks if gone in finding.text]


def test_second_exclusion_says_so_and_writes_nothing(ipsys: Ipsys, fitted: Path) -> None:
    first, second = [m.id for m in measured(fitted)][:2]
    assert ipsys("exclude", fitted, first, "--reason", "moved").code == 0
    before = fitted.read_bytes()
    again = ipsys("exclude", fitted, first, "--reason", "moved again")
    assert (again.code, again.err) == (0, f"{first} is excluded already: moved\n")
    assert "is unchanged" in again.out
    active = ipsys("exclude", fitted, second, "--readmit", "--reason", "why not", "--json")
    assert active.err == f"{second} is not excluded\n"
    assert json.loads(active.out)["readmitted"] == []
    assert fitted.read_bytes() == before
    # One new point and one excluded point: only the new one gets a message.
    count = len(measured(fitted))
    assert ipsys("exclude", fitted, first, second, "--reason", "both moved").code == 0
    assert len(measured(fitted)) == count + 1


def test_unknown_point_names_the_points_of_the_log(ipsys: Ipsys, fitted: Path) -> None:
    before, names = fitted.read_bytes(), [m.id for m in measured(fitted)]
    done = ipsys("exclude", fitted, names[0], "p999", "--reason", "moved")
    assert (done.code, done.out) == (1, "")
    assert f"has no calibration point 'p999'; it has {names[0]}, {names[1]}" in done.err.replace("\n", " ")
    empty = ipsys("exclude", fitted, names[0], "--reason", "  ")
    assert (empty.code, empty.err.startswith("ipsys: --reason: is missing")) == (1, True)
    assert fitted.read_bytes() == before


def test_name_of_a_point_excludes_all_its_measurements(tmp_path: Path) -> None:
    log = tmp_path / "points.mcap"
    rows = [
        Measurement(100 + n, f"{camera}_1", marker_id=1, calibration_point="corner")
        for n, camera in enumerate(("red", "white"))
    ]
    write_log(log, (Message("/measurements", one.timestamp, one.timestamp, one) for one in rows))
    assert exclude(log, ["corner"], "moved").changed == ("red_1", "white_1")
    assert active_measurements(measured(log)) == []


def test_excluded_points_are_not_faulty(tmp_path: Path) -> None:
    """A repeated id, or a point without a marker, is an error only as long as it counts."""
    log = tmp_path / "a.mcap"
    rows = [
        Measurement(1, "a", marker_id=1),
        Measurement(2, "a", marker_id=1),
        Measurement(3, "c", marker_id=1),
    ]
    faulty = [*rows, Measurement(4, "b")]
    for history, name in ((rows, "'a'"), (faulty[2:], "b has no marker")):
        with pytest.raises(IpsysError, match=name):
            active_measurements(history)
    write_log(log, (Message("/measurements", one.timestamp, one.timestamp, one) for one in faulty))
    exclude(log, ["a", "b"], "typed twice, and without a marker")
    assert [one.id for one in active_measurements(measured(log))] == ["c"]
    again = Measurement(9, "r", readmits="a", reason="it was right")
    assert [one.timestamp for one in active_measurements([*measured(log), again])] == [2, 3]


def test_measuring_page_shows_the_reason_of_an_exclusion(detected_lab: Path) -> None:
    from ipsys_log.app.web.app import history_json
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.survey.from_log import open_finished_log

    name = measured(detected_lab)[0].id
    exclude(detected_lab, [name], "the tape sagged")
    with open_finished_log(detected_lab, Request()) as scene:
        places = {row["id"]: row for row in history_json(scene)["places"]}
    assert (places[name]["counts"], places[name]["reason"]) == (False, "the tape sagged")
    assert sum(row["counts"] for row in places.values()) == len(places) - 1


NAMES = ("a", "b", "c")


@given(st.lists(st.tuples(st.sampled_from(("measure", "exclude", "readmit")), st.sampled_from(NAMES))))
def test_last_message_about_a_point_decides(steps: list[tuple[str, str]]) -> None:
    """The oracle keeps a list of points with a mark each."""
    history: list[Measurement] = []
    oracle: list[list[object]] = []
    for number, (kind, name) in enumerate(steps):
        row = next((row for row in oracle if row[0] == name), None)
        if kind == "measure":
            if row is not None and row[2]:
                continue  # a second measurement of a valid id is an error
            if row is not None:
                oracle.remove(row)
            oracle.append([name, number, True])
            history.append(Measurement(number, name, marker_id=1))
            continue
        if row is not None:
            row[2] = kind == "readmit"
        withdraws, readmits = (name, None) if kind == "exclude" else (None, name)
        message = Measurement(number, f"{kind}_{number}", withdraws, readmits=readmits, reason="why")
        # The reason and the name survive the log.
        history.append(decode(schema_name(Measurement), encode(message)))
    assert [(m.id, m.timestamp) for m in active_measurements(history)] == [
        (name, number) for name, number, is_active in oracle if is_active
    ]
    points = {m.id for m in history if m.is_point}
    assert points - withdrawals(history).keys() == {m.id for m in active_measurements(history)}
