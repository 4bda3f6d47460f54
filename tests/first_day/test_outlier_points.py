"""Points that contradict the fit: each is named with its log, and can be excluded there."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.api import python_api as api
from ipsys_log.app.first_day.lab_folder import LabFolder, exclude_outlier, find_outlier_points
from ipsys_log.app.first_day.steps import Status, read_progress
from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.engine.output import write_messages
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.lab_files import simulated_lab_texts, write_new
from ipsys_log.live_runs.survey.from_log import place_in_log
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import Distance, Evaluation, Measurement, Suspect
from ipsys_log.messages.channels import MEASUREMENTS


def write_points(path: Path, ids: list[str], begin_ns: int) -> Path:
    distances = (Distance("A", 1.0), Distance("B", 2.0))
    payloads = [
        Measurement(begin_ns + n, name, marker_id=0, distances=distances) for n, name in enumerate(ids)
    ]
    with LogWriter.create(path) as writer:
        write_messages(writer, [place_in_log(payload, []) for payload in payloads])
    return path


def contradicted(*names: str) -> Accuracy:
    suspects = tuple(Suspect(name, ("red",), np.array([0.03, 0.04, 0.0]), 9.0) for name in names)
    return Accuracy("poly", Evaluation(0, "poly", (), suspects=suspects), None)


def test_point_of_the_later_log_is_named_as_in_its_log(tmp_path: Path) -> None:
    later = write_points(tmp_path / "a.mcap", ["p001", "p002"], 2_000)
    earlier = write_points(tmp_path / "b.mcap", ["p001", "p002"], 1_000)
    with Session([later, earlier]) as session:
        assert {p.id for p in session.payloads(session.topics(MEASUREMENTS))} == {
            "p001",
            "p002",
            "p001_2",
            "p002_2",
        }
    found = find_outlier_points([later, earlier], [contradicted("p002_2", "p001")])
    assert {(one.log, one.point) for one in found} == {("a.mcap", "p002"), ("b.mcap", "p001")}
    assert found[0].error_cm == pytest.approx(5.0)
    exclude_outlier([later, earlier], "a.mcap", "p002")
    # An excluded point is not named again, and the other log is unchanged.
    found = find_outlier_points([later, earlier], [contradicted("p002_2", "p002")])
    assert [(one.log, one.point) for one in found] == [("b.mcap", "p002")]


def test_log_that_is_not_in_the_folder_is_refused(tmp_path: Path) -> None:
    path = write_points(tmp_path / "a.mcap", ["p001"], 1_000)
    with pytest.raises(IpsysError, match=r"no log '\.\./b\.mcap'"):
        exclude_outlier([path], "../b.mcap", "p001")


@pytest.mark.slow
def test_excluded_outlier_leaves_a_fit_out_of_date_then_good(tmp_path: Path, detected_log: Path) -> None:
    folder = LabFolder(tmp_path)
    write_new(simulated_lab_texts(folder.rig_file))
    log = Path(shutil.copy(detected_log, tmp_path / "calibration.mcap"))
    with Session([log]) as session:
        messages = list(session.messages(session.topics(MEASUREMENTS)))
    point = messages[len(messages) // 2].payload
    read = (replace(point.distances[0], distance_m=point.distances[0].distance_m + 0.3), *point.distances[1:])
    wrong = replace(point, id="wrong", calibration_point=None, distances=read)
    withdrawn = Measurement(point.timestamp, "w1", withdraws=point.id)
    with LogWriter.append(log) as writer:
        write_messages(writer, [place_in_log(payload, messages) for payload in (withdrawn, wrong)])
    api.replay(log)
    fit = read_progress(folder).fit
    assert fit is not None
    assert [(one.log, one.point) for one in fit.outliers] == [("calibration.mcap", "wrong")]
    assert fit.outliers[0].error_cm > 5
    exclude_outlier(folder.calibration_logs(), "calibration.mcap", "wrong")
    assert read_progress(folder).step("accuracy").status is Status.READY
    api.replay(log)
    progress = read_progress(folder)
    assert progress.step("accuracy").status is Status.DONE
    assert progress.fit is not None
    assert progress.fit.outliers == ()
