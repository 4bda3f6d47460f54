"""``ipsys calibrate-lab`` on the command line, in simulated labs without images."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.payload import restore_joint
from ipsys_log.capture.simulation.settings import FLOOR_M, LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.exchange.calibration_files import read_intrinsics
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, Distance, Markers, Measurement, Message, Rig
from ipsys_log.messages.channels import MODEL
from tests.conftest import Ipsys
from tests.geometric.floor_error import KnownSightings, compute_errors, grid_nodes, summarize
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

# Smaller than a real session: the fit takes about two seconds.
SETTINGS = GeometricSettings(lab=LabSettings(rate_hz=6.0, drive_s=25.0, seed=3), points=6)


@pytest.fixture(scope="module")
def lab() -> GeometricLab:
    return build_lab(SETTINGS)


@pytest.fixture(scope="module")
def session_log(lab: GeometricLab, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lab") / "lab.mcap"
    write_log(path, simulate_session(lab))
    return path


@pytest.fixture(scope="module")
def fitted_log(session_log: Path) -> Path:
    from ipsys_log.api import python_api as api

    path = Path(shutil.copy(session_log, session_log.with_name("fitted.mcap")))
    api.replay(path, models=["joint"], until="fit")
    return path


@pytest.fixture
def fitted(fitted_log: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(fitted_log, tmp_path / "lab.mcap"))


def changed(lab: GeometricLab, path: Path, change: Any) -> Path:
    """Write the session of a lab with changed messages; ``change`` returns None to leave one out."""

    def messages() -> Iterator[Message]:
        for message in simulate_session(lab):
            new = change(message)
            if new is not None:
                yield new

    write_log(path, messages())
    return path


def described(ipsys: Ipsys, *arguments: object) -> dict[str, Any]:
    done = ipsys("calibrate-lab", *arguments, "--json")
    assert done.code == 0, done.err
    answer = json.loads(done.out)
    assert isinstance(answer, dict)
    return answer


def refused(ipsys: Ipsys, *arguments: object) -> str:
    done = ipsys("calibrate-lab", *arguments)
    assert (done.code, done.out) == (1, ""), done.err
    lines = [line for line in done.err.splitlines() if line.startswith("ipsys: ")]
    assert len(lines) == 1, done.err
    return lines[0]


def true_error_m(lab: GeometricLab, log: Path) -> tuple[float, float]:
    """Return the mean 2D error over the floor, and that after the best rigid alignment."""
    with Session([log]) as session:
        (model,) = session.payloads(session.topics(MODEL, "joint"))
    cameras = restore_joint(model)
    settings = lab.settings.lab
    length_m = settings.marker_length_m

    def place(poses: Any, side_m: float) -> Any:
        return lab.place(poses).corners_m(side_m)

    def locator(camera: str, corners_px: Any, heights_m: Any, covariances_px2: Any = None) -> Any:
        count = len(corners_px)
        exact = np.broadcast_to(1e-4 * np.eye(8), (count, 8, 8))
        located = locate_markers(cameras[camera], corners_px, exact, heights_m, np.full(count, length_m))
        return located.points_m, located.covariances_m2

    nodes: list[KnownSightings] = [
        grid_nodes(c.lens, c.camera_from_world, place, (FLOOR_M, FLOOR_M), settings.drive_height_m, length_m)
        for c in lab.cameras
    ]
    error = summarize(compute_errors(nodes, locator), np.zeros((0, 2)))
    return error.mean_m, error.aligned_mean_m


def test_the_answer_is_first_and_fits_into_80_columns(
    ipsys: Ipsys, fitted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    done = ipsys("calibrate-lab", fitted, "--goal-mm", "1")
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert lines[0].startswith("Not enough: the expected mean error of ")
    assert lines[0].endswith("; the goal is 1 mm.")
    # Only advice may be longer: the terminal wraps it between words.
    assert (
        max(len(line) for line in lines if not line.startswith(("Drive", "Tape", "Then", "The scale"))) <= 80
    )
    assert [line.split()[0] for line in lines[4:8]] == ["black", "red", "white", "all"]
    assert any(line.startswith("Tape a point near x ") for line in lines)
    done = ipsys("calibrate-lab", fitted, "--goal-mm", "20")
    assert done.out.startswith("Enough: the expected mean error of each camera is ")
    assert "Tape" not in done.out


def test_contradicted_intrinsics_are_never_enough(ipsys: Ipsys, lab: GeometricLab, tmp_path: Path) -> None:
    def zoomed(message: Message) -> Message:
        lens = message.payload
        if not isinstance(lens, CameraCalibration) or message.camera != "red":
            return message
        return replace(message, payload=replace(lens, K=lens.K * [[1.1], [1.1], [1]]))

    path = changed(lab, tmp_path / "zoomed.mcap", zoomed)
    answer = described(ipsys, path, "--goal-mm", "1000")
    assert not answer["enough"]
    (text,) = answer["contradictions"]
    assert text.startswith("camera red: markers do not fit its calibration (")
    done = ipsys("calibrate-lab", path, "--goal-mm", "1000")
    assert done.out.startswith("Not enough: ")
    assert text in done.out


def test_expected_error_agrees_with_the_ground_truth(ipsys: Ipsys, lab: GeometricLab, fitted: Path) -> None:
    answer = described(ipsys, fitted)
    mean_m, _ = true_error_m(lab, fitted)
    # The error of one lab varies by a factor of about two, because the tape moves all cameras together.
    assert 0.3 < mean_m / answer["mean_m"] < 2.5
    for camera in answer["cameras"]:
        assert 0 < camera["mean_m"] < camera["p95_m"] < 3 * camera["mean_m"]
        assert 0.005 < camera["residual_px"] < 0.05
        assert camera["moving"] > 50


def test_clock_offset_is_that_of_the_stored_model(ipsys: Ipsys, fitted: Path) -> None:
    """The clocks of the lab are synchronised: their offsets are not significant, so the model stores 0."""
    printed_s = {camera["camera"]: camera["clock_s"] for camera in described(ipsys, fitted)["cameras"]}
    with Session([fitted]) as session:
        (model,) = session.payloads(session.topics(MODEL, "joint"))
    stored_s = {name: camera.clock_s for name, camera in restore_joint(model).items()}
    assert printed_s == stored_s
    assert list(printed_s.values()).count(0.0) >= 2


def test_a_proposed_point_gives_the_predicted_error(
    ipsys: Ipsys, lab: GeometricLab, fitted: Path, tmp_path: Path
) -> None:
    """The prediction of the small linear system equals that of a fit with one more taped point."""
    answer = described(ipsys, fitted, "--goal-mm", "0.5")
    best = answer["tape"][0]
    assert best["mean_after_m"] < answer["mean_m"]
    later = [point["mean_after_m"] for point in answer["tape"]]
    assert later == sorted(later, reverse=True)
    point = replace(lab.points[0][0], x_m=best["x_m"], y_m=best["y_m"], z_m=0.0)
    more = replace(lab, points=(*lab.points, (point,)), settings=replace(lab.settings, points=7))
    log = tmp_path / "more.mcap"
    write_log(log, simulate_session(more))
    measured = described(ipsys, log)
    assert measured["mean_m"] == pytest.approx(best["mean_after_m"], rel=0.1)


@pytest.mark.slow
def test_plan_for_joint_names_points_and_a_drive(ipsys: Ipsys, fitted: Path, tmp_path: Path) -> None:
    drawn = tmp_path / "plan.png"
    done = ipsys("plan", fitted, "--model", "joint", "--places", "3", "--plot", drawn, "--json")
    assert done.code == 0, done.err
    answer = json.loads(done.out)
    places = [(place["x_m"], place["y_m"]) for place in answer["places"]]
    assert len(set(places)) == 3
    means_m = [answer["mean_before_m"], *(place["mean_after_m"] for place in answer["places"])]
    assert means_m == sorted(means_m, reverse=True)
    assert means_m[-1] < 0.9 * means_m[0]
    assert all(place["height_m"] == 0 and place["cameras"] for place in answer["places"])
    drive = answer["drive"]
    assert drive["mean_after_m"] < drive["mean_before_m"] < 0.01
    assert cv2.imread(str(drawn)) is not None


@pytest.mark.slow
def test_plan_for_joint_proposes_a_drive_only_if_it_helps(
    ipsys: Ipsys, fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = ipsys("plan", fitted, "--model", "joint", "--places", "1").out
    assert max(map(len, text.splitlines())) <= 80
    # After a drive, the error is that of the tape; without a drive, another one helps.
    assert "another drive changes little" in text
    still = replace(SETTINGS, lab=replace(SETTINGS.lab, drive_s=0.0))
    points_only = tmp_path / "points.mcap"
    write_log(points_only, simulate_session(build_lab(still)))
    text = ipsys("plan", points_only, "--model", "joint", "--places", "1").out
    assert "or drive a robot for 30 s, in curves, through x " in text
    high = ipsys("plan", fitted, "--model", "joint", "--places", "1", "--height-m", "0.3", "--json")
    assert json.loads(high.out)["places"][0]["height_m"] == 0.3


def test_the_model_is_the_usual_run(ipsys: Ipsys, session_log: Path, tmp_path: Path) -> None:
    log = Path(shutil.copy(session_log, tmp_path / "lab.mcap"))
    done = ipsys("calibrate-lab", log)
    assert done.code == 0, done.err
    assert "fit           run joint     1 message" in done.err
    again = ipsys("calibrate-lab", log)
    assert again.out == done.out
    assert "nothing to do" in again.err
    located = ipsys("locate", log, "--model", "joint")
    assert located.code == 0, located.err
    assert "run joint" in located.err


def test_the_map_is_drawn(ipsys: Ipsys, fitted: Path) -> None:
    drawn = fitted.with_name("floor.png")
    done = ipsys("calibrate-lab", fitted, "--plot", drawn, "--goal-mm", "1")
    assert done.code == 0, done.err
    picture = cv2.imread(str(drawn))
    assert picture is not None
    # One panel for each of three cameras: shades of blue in each third of the picture.
    for part in np.array_split(picture[:, :1350].astype(int), 3, axis=1):
        assert ((part[..., 0] - part[..., 2]) > 40).sum() > 5000


def test_a_wrong_reading_is_named_first(ipsys: Ipsys, lab: GeometricLab, tmp_path: Path) -> None:
    def wrong(message: Message) -> Message:
        payload = message.payload
        if not isinstance(payload, Measurement) or payload.id != "s002":
            return message
        first, second = payload.distances
        shorter = replace(first, distance_m=first.distance_m - 0.1)
        return replace(message, payload=replace(payload, distances=(shorter, second)))

    log = changed(lab, tmp_path / "wrong.mcap", wrong)
    done = ipsys("calibrate-lab", log, "--goal-mm", "1000")
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    # One of six points: another fault may explain its reading.
    assert lines[0] == "Not enough: correct the faults of the observations first."
    assert "probable fault" in lines[1]
    assert lines[2].startswith("  point s002: ")


@pytest.mark.slow
def test_nominal_field_of_view_replaces_a_chessboard(ipsys: Ipsys, lab: GeometricLab, tmp_path: Path) -> None:
    def bare(message: Message) -> Message | None:
        return None if isinstance(message.payload, CameraCalibration) else message

    log = changed(lab, tmp_path / "bare.mcap", bare)
    assert "has no calibration" in refused(ipsys, log)
    folder = tmp_path / "lenses"
    answer = described(ipsys, log, "--focal", "1200", "--save-nominal", folder)
    assert any("nominal intrinsics of camera black, red, white" in note for note in answer["notes"])
    assert all(camera["nominal"] for camera in answer["cameras"])
    assert answer["mean_m"] < 0.005
    mean_m, _ = true_error_m(lab, log)
    assert mean_m < 0.006
    nominal = read_intrinsics(folder / "red.yaml", "red")
    assert (nominal.K[0, 0], nominal.width, nominal.height) == (1200, 1920, 1080)
    line = refused(ipsys, log, "--focal", "1200", "--save-nominal", folder)
    assert line.endswith("black.yaml: exists already; give another folder to --save-nominal")
    lenses = [option for c in lab.cameras for option in ("--calibration", f"{c.name}={folder / c.name}.yaml")]
    # Files with nominal values stay nominal, and give the same result.
    assert described(ipsys, log, *lenses)["mean_m"] == answer["mean_m"]
    assert "--save-nominal needs --focal or --field-of-view" in refused(
        ipsys, log, *lenses, "--save-nominal", tmp_path
    )
    assert "no camera 'blue'" in refused(ipsys, log, "--focal", "blue=1200")
    assert "--focal wide: is not a number above 0" in refused(ipsys, log, "--focal", "wide")
    assert "a focal length of 3 px is impossible" in refused(ipsys, log, "--focal", "3")
    assert "the field of view is 300 degrees" in refused(ipsys, log, "--field-of-view", "300")


def test_markers_on_two_reference_points_replace_the_tape(
    ipsys: Ipsys, lab: GeometricLab, tmp_path: Path
) -> None:
    points = {p.name: (p.x_m, p.y_m) for p in _rig(lab).reference_points}
    poses = [
        replace(lab.points[0][0], x_m=x_m, y_m=y_m, z_m=0.0, marker_id=0) for x_m, y_m in points.values()
    ]
    placed = replace(
        lab, points=tuple((pose,) for pose in poses), settings=replace(lab.settings, points=len(poses))
    )
    names = iter(points)

    def on_reference(message: Message) -> Message:
        if not isinstance(message.payload, Measurement):
            return message
        on_it = (Distance(next(names), 0.0),)
        return replace(message, payload=replace(message.payload, distances=on_it, side=None, height_m=0.0))

    log = changed(placed, tmp_path / "placed.mcap", on_reference)
    answer = described(ipsys, log, "--goal-mm", "3")
    assert answer["calibration_points"] == 2
    assert answer["enough"]
    mean_m, aligned_m = true_error_m(placed, log)
    # The markers are exactly on the reference points, so the frame is nearly exact.
    assert mean_m < 0.0015
    assert aligned_m < 0.001


def _rig(lab: GeometricLab) -> Rig:
    from tests.geometric.session import geometric_rig

    return geometric_rig(lab)


def test_impossible_input_is_refused(ipsys: Ipsys, lab: GeometricLab, fitted: Path, tmp_path: Path) -> None:
    assert "does not exist" in refused(ipsys, tmp_path / "none.mcap")
    for goal in ("0", "-1", "nan", "inf", "2000"):
        assert f"--goal-mm {goal}: is not a length" in refused(ipsys, fitted, "--goal-mm", goal)
    line = refused(ipsys, fitted, "--focal", "1200")
    assert line.endswith("--focal 1200: every camera has a calibration; to replace one, write black=1200")
    assert "no log is given; name a log, or give --rig lab.toml -o lab.mcap" in refused(ipsys)
    for option in (("--seconds", "3"), ("--terminal",), ("--force",), ("--host", "0.0.0.0")):
        assert f"{option[0]} is only for live cameras" in refused(ipsys, fitted, *option)
    no_rig = changed(lab, tmp_path / "norig.mcap", lambda m: None if isinstance(m.payload, Rig) else m)
    assert "has no rig" in refused(ipsys, no_rig)

    def unmarked(message: Message) -> Message | None:
        return None if isinstance(message.payload, Markers) else message

    assert "has no images and no markers" in refused(
        ipsys, changed(lab, tmp_path / "unmarked.mcap", unmarked)
    )


def test_camera_without_overlap_and_tape_is_left_out(ipsys: Ipsys, lab: GeometricLab, tmp_path: Path) -> None:
    """Camera red sees other robots than the rest, and none of the measured points."""

    def apart(message: Message) -> Message:
        payload = message.payload
        if isinstance(payload, Rig):
            return replace(message, payload=replace(payload, markers=()))
        if isinstance(payload, Markers) and message.camera == "red":
            moved = tuple(replace(m, id=m.id + 6) for m in payload.markers)
            return replace(message, payload=replace(payload, markers=moved))
        return message

    done = ipsys("calibrate-lab", changed(lab, tmp_path / "apart.mcap", apart))
    assert done.code == 0, done.err
    assert "camera red: it sees fewer than two measured points" in done.err
    assert "drive a robot through the overlap; it is left out" in done.err
    assert "camera red saw no marker of the fit: it has no model" in done.err


def test_a_camera_without_a_marker_is_not_enough(ipsys: Ipsys, lab: GeometricLab, tmp_path: Path) -> None:
    def blind(message: Message) -> Message:
        if isinstance(message.payload, Markers) and message.camera == "red":
            return replace(message, payload=replace(message.payload, markers=()))
        return message

    log = changed(lab, tmp_path / "blind.mcap", blind)
    done = ipsys("calibrate-lab", log, "--goal-mm", "50")
    assert done.code == 0, done.err
    assert done.out.startswith("Not enough: camera red has no model.")


# Records simulated cameras in real time.
@pytest.mark.slow
def test_live_cameras_are_recorded_and_points_are_asked_for(ipsys: Ipsys, tmp_path: Path) -> None:
    rig, log = tmp_path / "lab.toml", tmp_path / "lab.mcap"
    assert ipsys("init", rig, "--simulated").code == 0
    options = ("--rig", rig, "-o", log, "--seconds", "12", "--port", "0")
    done = ipsys("calibrate-lab", *options)
    # Nobody entered a point: the drive is in the log, and the error names the next command.
    assert done.code == 1
    assert f"enter some with 'ipsys measure {log}'" in done.err
    assert "markers were in these parts of the images: " in done.err
    assert ipsys("measure", log, "--csv", tmp_path / "lab_tape.csv", "--force").code == 0
    answer = described(ipsys, log)
    assert [camera["camera"] for camera in answer["cameras"]] == ["black", "red", "white"]
    assert answer["mean_m"] < 0.004
