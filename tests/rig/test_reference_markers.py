"""Reference markers in the rig: the file, its faults, and the stages that must leave them out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.app.report.prints import rig_prints
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import decode, encode
from ipsys_log.messages import (
    CameraCalibration,
    CameraPoints,
    Marker,
    Markers,
    Message,
    ReferenceMarker,
    Rig,
    RigMarker,
)
from ipsys_log.messages.rig_file import load_rig, rig_toml
from ipsys_log.stages.camera_frame import CameraFrame
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.weeks import WeekSettings, reference_rig, simulate_week

RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    (RigMarker(0, robot="ada"),),
    marker_height_m=0.1,
    reference_markers=(ReferenceMarker(90), ReferenceMarker(91, 0.15)),
)


def test_rig_file_and_log_keep_reference_markers(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(rig_toml(RIG))
    assert load_rig(path) == RIG
    assert decode("ipsys.v1.Rig", encode(RIG)) == RIG


def test_reference_marker_is_known_and_no_robot_carries_it() -> None:
    assert [RIG.knows(one) for one in (0, 1, 90, 91)] == [True, False, True, True]
    assert [RIG.is_reference(one) for one in (0, 90)] == [False, True]
    assert (RIG.length_of(90), RIG.length_of(91)) == (0.2, 0.15)
    assert (RIG.height_of(0), RIG.height_of(90)) == (0.1, 0.0)
    assert replace(RIG, markers=()).knows(7)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[[reference_markers]]\nid = 0", "two markers have the id 0"),
        ("[[reference_markers]]\nid = 100", "has only the ids 0 to 99"),
        ("[[reference_markers]]\nid = 90\nlength_m = 15.0", "write 0.15 if it is in cm"),
        ("[[reference_markers]]\nlength_m = 0.15", "number 1: id is missing"),
        ("[[reference_marker]]\nid = 90", "use reference_markers"),
    ],
)
def test_faults_of_reference_markers_are_named(tmp_path: Path, text: str, fault: str) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(rig_toml(replace(RIG, reference_markers=())) + text)
    with pytest.raises(IpsysError, match=fault):
        load_rig(path)


def test_prints_of_a_rig_include_reference_markers() -> None:
    assert [one.lines[0] for one in rig_prints(RIG)] == ["id 0, ada", "id 90, reference", "id 91, reference"]


def test_reference_markers_get_no_camera_points() -> None:
    K = np.array([[1150.0, 0, 959.5], [0, 1150, 539.5], [0, 0, 1]])
    lens = CameraCalibration(0, "red", 1920, 1080, "kannala_brandt", np.zeros(4), K)
    square_px = np.array([[900.0, 500.0], [1000.0, 500.0], [1000.0, 600.0], [900.0, 600.0]])
    markers = (Marker(0, square_px), Marker(90, square_px + 200))
    stage, frames = CameraFrame(), [markers, markers[1:]]
    list(stage(Message("/rig", 0, 0, RIG)))
    list(stage(Message("/cameras/red/calibration", 0, 0, lens, "red")))
    seen = []
    for number, frame in enumerate(frames):
        message = Message(
            "/runs/edges/cameras/red/markers", number, number, Markers(number, frame, 1920, 1080), "red"
        )
        (points,) = [one for one in stage(message) if isinstance(one, CameraPoints)]
        seen.append([point.id for point in points.points])
    assert seen == [[0], []]


def test_simulated_week_is_repeatable_and_weeks_differ() -> None:
    lab = build_lab(GeometricSettings(lab=LabSettings(seed=3, drive_s=0.0, markers=1), points=1))
    settings = WeekSettings(duration_s=0.3)
    weeks = [[encode(m.payload) for m in simulate_week(lab, settings, week)] for week in (1, 1, 2)]
    assert weeks[0] == weeks[1] != weeks[2]
    assert {one.id for one in reference_rig(lab, settings).reference_markers} == set(range(90, 97))
