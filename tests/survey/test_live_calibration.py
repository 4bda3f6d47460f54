"""The calibration beside a recording: its lines, and its independence of errors."""

import re
from collections import deque
from collections.abc import Mapping
from dataclasses import replace

import pytest

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.live_runs.survey.live_calibration import LiveCalibration
from ipsys_log.messages import CameraCalibration, Measurement, Message, Rig
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import geometric_rig, simulate_session

LAB = build_lab(GeometricSettings(lab=LabSettings(rate_hz=6.0, drive_s=12.0, seed=3), points=6))


def lines_of(
    messages: list[Message],
    rig: Rig,
    goal_m: float = 0.05,
    lenses: Mapping[str, CameraCalibration] = LAB.calibrations,
) -> tuple[list[str], LiveCalibration]:
    lines: list[str] = []
    live = LiveCalibration(rig, lenses, goal_m, lines.append, every_s=4.0)
    for message in messages:
        live(message)
        if live._fitting is not None:
            live._fitting.result()
    live.close()
    return lines, live


def test_lines_show_coverage_and_then_the_expected_error() -> None:
    lines, live = lines_of(list(simulate_session(LAB)), geometric_rig(LAB))
    assert live.lab is not None
    assert live.lab.is_enough
    assert [camera.camera for camera in live.lab.cameras] == ["black", "red", "white"]
    assert lines[-1].startswith("expected mean error in mm: black ")
    assert lines[-1].endswith("; enough: Ctrl-C ends the recording")
    assert live.lab.mean_m < 0.004


def test_contradicted_intrinsics_are_the_line_instead_of_enough() -> None:
    red = LAB.calibrations["red"]
    lenses = {**LAB.calibrations, "red": replace(red, K=red.K * [[1.1], [1.1], [1]])}
    lines, live = lines_of(list(simulate_session(LAB)), geometric_rig(LAB), 1.0, lenses)
    assert live.lab is not None
    assert not live.lab.is_enough
    assert "; camera red: markers do not fit its calibration (" in lines[-1]


def test_no_measured_point_gives_coverage_only() -> None:
    messages = [m for m in simulate_session(LAB) if not isinstance(m.payload, Measurement)]
    lines, live = lines_of(messages, geometric_rig(LAB))
    assert live.lab is None
    assert lines
    assert all(line.startswith("markers were in these parts of the images: ") for line in lines)
    first, last = (sum(map(int, re.findall(r"(\d+)%", line))) for line in (lines[0], lines[-1]))
    assert last > first


# A drive of a minute with several fits.
@pytest.mark.slow
def test_goal_that_is_not_reached_names_the_next_step() -> None:
    lines, _ = lines_of(list(simulate_session(LAB)), geometric_rig(LAB), goal_m=0.0005)
    assert "; drive through x " in lines[-1] or "; tape a point near x " in lines[-1]


@pytest.mark.parametrize("at", ["message", "close"])
def test_bug_of_a_live_fit_is_raised(monkeypatch: pytest.MonkeyPatch, at: str) -> None:
    """A bug in the thread of the fit is no line of text, and is not lost, also if it is in the last fit."""

    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("ipsys_log.live_runs.survey.live_calibration.fit_without", fail)
    lines: list[str] = []
    live = LiveCalibration(geometric_rig(LAB), LAB.calibrations, 0.05, lines.append, every_s=4.0)
    messages = iter(list(simulate_session(LAB)))
    while live._fitting is None or live._fitting.exception() is None:
        live(next(messages))
    finish = live.close if at == "close" else lambda: deque(map(live, messages))
    with pytest.raises(ZeroDivisionError, match="a bug"):
        finish()
    assert not any("no fit yet" in line for line in lines)
