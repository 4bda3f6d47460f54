"""The state of the steps comes from the files of the folder: resumed, finished elsewhere, or damaged."""

import os
import shutil
from pathlib import Path

import pytest

from ipsys_log.api import python_api as api
from ipsys_log.app.first_day.camera_choice import save_cameras, set_calibration
from ipsys_log.app.first_day.lab_folder import LabFolder, LogFacts
from ipsys_log.app.first_day.rig_entry import save_rig_entry
from ipsys_log.app.first_day.steps import Status, read_progress
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.exchange.lab_files import simulated_lab_texts, write_new
from ipsys_log.live_runs.survey.checks import withdrawal_of
from ipsys_log.live_runs.survey.from_log import open_finished_log
from ipsys_log.statistics.calibration_points import ENOUGH_TAPE_POINTS
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.test_record import lens_yaml

D, R, W = Status.DONE, Status.READY, Status.WAITS
RIG = 'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
USB = f'{RIG}[[cameras]]\nname = "red"\nsource = "usb:{os.devnull}"\n'

DRONE = """
[[markers]]
id = 90
length_m = 0.1
robot = "drone"
[[markers]]
id = 91
length_m = 0.1
robot = "drone"
[[bodies]]
robot = "drone"
level = false
"""


def statuses(folder: LabFolder) -> list[Status]:
    return [step.status for step in read_progress(folder).steps]


@pytest.fixture
def folder(tmp_path: Path) -> LabFolder:
    (tmp_path / "lab").mkdir()
    return LabFolder(tmp_path / "lab")


def test_empty_folder_begins_with_the_rig(folder: LabFolder) -> None:
    assert statuses(folder) == [R, W, W, W, W, W, W, W]
    assert read_progress(folder).next == "rig"


def test_rig_without_sources_asks_for_cameras(folder: LabFolder) -> None:
    save_rig_entry(folder.rig_file, {})
    assert statuses(folder) == [D, R, W, W, W, W, W, W]


def test_simulated_lab_has_cameras_and_intrinsics(folder: LabFolder) -> None:
    write_new(simulated_lab_texts(folder.rig_file))
    assert statuses(folder) == [D, D, D, R, R, R, W, W]
    assert folder.sheet is not None


def test_damaged_rig_is_named_and_can_be_corrected(folder: LabFolder) -> None:
    folder.rig_file.write_text('name = "lab"\nmarker_length_m = 20\n')
    progress = read_progress(folder)
    assert progress.next == "rig"
    assert "lab.toml" in progress.step("rig").text
    folder.rig_file.write_text(RIG)
    assert statuses(folder)[0] is D


def test_intrinsics_are_noticed_by_their_file(folder: LabFolder) -> None:
    folder.rig_file.write_text(USB)
    assert statuses(folder) == [D, D, R, W, W, W, W, W]
    assert "--camera red" in read_progress(folder).step("intrinsics").command
    (folder.path / "red.yaml").write_text(lens_yaml(640, 480))
    (one,) = read_progress(folder).intrinsics
    assert (one.known, one.file) == (False, "red.yaml")
    set_calibration(folder.rig_file, "red", "red.yaml")
    assert statuses(folder)[:3] == [D, D, D]
    (folder.path / "red.yaml").write_text("nothing")
    (one,) = read_progress(folder).intrinsics
    assert (one.known, "red.yaml" in one.text) == (False, True)


def test_missing_device_is_a_fault_of_the_cameras(folder: LabFolder) -> None:
    folder.rig_file.write_text(USB.replace(os.devnull, "/dev/none"))
    step = read_progress(folder).step("cameras")
    assert (step.status, "'/dev/none' does not exist" in step.text) == (R, True)


def test_log_from_the_terminal_finishes_steps(
    folder: LabFolder, lab_log: Path, replayed_log: Path, recorded: Path
) -> None:
    write_new(simulated_lab_texts(folder.rig_file))
    log = Path(shutil.copy(lab_log, folder.path / "session.mcap"))
    # Without a detection, the points of each camera are not known.
    assert statuses(folder)[4:] == [R, R, R, W]
    assert "ipsys replay session.mcap --model poly" in read_progress(folder).step("accuracy").command
    shutil.copy(replayed_log, log)
    progress = read_progress(folder)
    # More than 15 points for each camera: the tape alone is enough, without a drive.
    assert min(progress.logs[0].seen.values()) >= ENOUGH_TAPE_POINTS
    assert [step.status for step in progress.steps][4:] == [D, D, D, R]
    assert progress.fit is not None
    # The result of the Python API, by another road.
    (model,) = api.replay(log).evaluations.values()
    means_m = model.to_frame()["mean_m"]
    assert any(progress.fit.mean_m == pytest.approx(mean_m) for mean_m in means_m)
    assert progress.fit.answer[0].startswith("Model: ")
    plain = folder.rig_file.read_text()
    folder.rig_file.write_text(plain + DRONE)
    assert "calibrate-body carry.mcap --robot drone" in read_progress(folder).step("live").text
    folder.rig_file.write_text(plain)
    shutil.copy(recorded, folder.path / "monday.mcap")
    assert statuses(folder)[4:] == [D, D, D, D]


def test_withdrawn_point_makes_the_fit_out_of_date(folder: LabFolder, replayed_log: Path) -> None:
    write_new(simulated_lab_texts(folder.rig_file))
    log = Path(shutil.copy(replayed_log, folder.path / "calibration.mcap"))
    before = read_progress(folder)
    assert before.step("accuracy").status is D
    with open_finished_log(log, Request()) as scene:
        scene.add([withdrawal_of(scene.history(), str(scene.history()[0].id))])
    progress = read_progress(folder)
    step = progress.step("accuracy")
    assert (step.status, "measurements changed" in step.text) == (R, True)
    assert sum(one.points for one in progress.logs) == sum(one.points for one in before.logs) - 1


def test_log_that_is_written_now_does_not_count(folder: LabFolder, lab_log: Path) -> None:
    write_new(simulated_lab_texts(folder.rig_file))
    path = folder.new_log("calibration")
    shutil.copy(lab_log, path)
    assert statuses(folder)[6] is W
    folder.finish_log()
    assert statuses(folder)[6] is R
    assert folder.new_log("calibration").name == "calibration_2.mcap"


def test_damaged_log_is_named_and_others_count(folder: LabFolder, lab_log: Path) -> None:
    write_new(simulated_lab_texts(folder.rig_file))
    shutil.copy(lab_log, folder.path / "calibration.mcap")
    whole = lab_log.read_bytes()
    (folder.path / "killed.mcap").write_bytes(whole[: len(whole) // 2])
    progress = read_progress(folder)
    assert progress.step("accuracy").status is R
    assert ["ipsys repair" in log.fault for log in progress.logs if log.fault] == [True]


def test_log_without_a_rig_is_no_alignment(folder: LabFolder) -> None:
    """The rig of an imported log may be that of an option."""
    settings = LabSettings(rate_hz=5.0, drive_s=1.0, markers=1)
    lab = build_lab(GeometricSettings(lab=settings, points=0))
    rig, *messages = simulate_session(lab)
    path = folder.path / "imported.mcap"
    write_log(path, messages)
    api.replay(path, rig=rig.payload, until="camera-frame")
    assert [(log.alignment, log.fault) for log in folder.logs()] == [(None, "")]
    path.rename(folder.path / "alignment.mcap")
    (log,) = folder.logs()
    assert log.fault.endswith("alignment.mcap: has no rig; measure the alignment again")


@pytest.mark.parametrize(
    ("drive_s", "points", "seen", "status"),
    [
        (20.0, 3, (), R),
        (20.0, 4, (), D),
        (0.0, 44, (), R),  # not detected yet
        (0.0, 40, (20, 20, 14), R),
        (0.0, 15, (15, 15, 15), D),
    ],
)
def test_points_are_enough_at_the_number_of_the_docs(
    folder: LabFolder,
    monkeypatch: pytest.MonkeyPatch,
    drive_s: float,
    points: int,
    seen: tuple[int, ...],
    status: Status,
) -> None:
    write_new(simulated_lab_texts(folder.rig_file))
    counts = dict(zip(("red", "white", "black"), seen, strict=False))
    logs = [
        LogFacts(folder.path / "drive.mcap", drive_s=drive_s),
        LogFacts(folder.path / "c.mcap", points=points, seen=counts),
    ]
    monkeypatch.setattr(folder, "logs", lambda: logs)
    progress = read_progress(folder)
    step = progress.step("points")
    assert step.status is status
    assert ("4 with a drive, or 15 for each camera with the tape alone" in step.text) == (status is R)
    # The tape alone needs no drive.
    assert progress.step("drive").status is (R if status is R and not drive_s else D)


def test_drive_needs_the_height_of_a_robot(folder: LabFolder) -> None:
    save_rig_entry(folder.rig_file, {})
    assert save_cameras(folder.rig_file, {"sim:red": "red"}, []) == []
    step = read_progress(folder).step("drive")
    assert (step.status, "height of the robots' markers" in step.text) == (W, True)
    assert save_rig_entry(folder.rig_file, {"height_0": "0.2"}) == []
    assert read_progress(folder).step("drive").status is R
