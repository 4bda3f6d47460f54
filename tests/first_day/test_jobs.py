"""Jobs of the page: one at a time, with their errors, and a stop in order."""

import threading
from pathlib import Path

import pytest

from ipsys_log.app.first_day.jobs import Job, Jobs
from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.first_day.work import calibrate_lab
from ipsys_log.errors import IpsysError


def test_second_job_is_refused_until_the_first_ends() -> None:
    jobs, going = Jobs(), threading.Event()

    def work(job: Job) -> None:
        job.on_stop(going.set)
        going.wait()

    jobs.start("the fit", work)
    with pytest.raises(IpsysError, match="the fit is not finished"):
        jobs.start("the alignment", lambda job: None)
    jobs.close()
    assert jobs.present is not None
    assert (jobs.present.ended, jobs.present.is_stopped(), jobs.present.error) == (True, True, "")
    jobs.start("the alignment", lambda job: job.say("a\x1b[31mb"))
    jobs.close()
    (line,) = jobs.present.describe()["lines"]
    assert "\x1b" not in line


def test_error_of_a_job_is_one_line_and_a_bug_keeps_its_traceback() -> None:
    def fails(_: Job) -> None:
        raise IpsysError("red.yaml: cannot be read")

    def breaks(_: Job) -> None:
        raise ZeroDivisionError("by zero")

    jobs = Jobs()
    jobs.start("the fit", fails)
    jobs.close()
    assert jobs.present is not None
    assert (jobs.present.error, jobs.present.bug) == ("red.yaml: cannot be read", "")
    jobs.start("the fit", breaks)
    jobs.close()
    assert "internal error of ipsys: ZeroDivisionError" in jobs.present.error
    # A later job does not hide the bug.
    jobs.start("the fit", fails)
    jobs.close()
    (bug,) = jobs.bugs
    assert "in breaks" in bug


def test_stopped_fit_keeps_the_log_and_is_no_error(lab: Path, tmp_path: Path) -> None:
    folder = LabFolder(tmp_path)
    before = lab.read_bytes()
    jobs = Jobs()

    def fit(job: Job) -> None:
        job.stop()  # as the user, before the first frame is processed
        calibrate_lab(folder, job)

    jobs.start("the fit", fit)
    jobs.close()
    assert jobs.present is not None
    assert (jobs.present.error, jobs.bugs) == ("", [])
    assert "stopped" in jobs.present.describe()["lines"][-1]
    assert lab.read_bytes() == before


def test_stop_before_the_cameras_open_still_stops_them() -> None:
    job, stopped = Job("the live view"), threading.Event()
    job.stop()
    job.on_stop(stopped.set)
    assert stopped.is_set()
