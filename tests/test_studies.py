"""Studies on a log: comparison of models, wrong points, and impossible questions."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message, Model, Rig, RigMarker
from ipsys_log.messages.channels import MODEL, POSITIONS
from ipsys_log.messages.rig_file import rig_toml
from tests import labs
from tests.conftest import Ipsys


def made(path: Path, seed: int = 0, count: int = 40, spoil: object = None, **options: object) -> Path:
    """Write a log of one camera's points, after ``spoil`` has changed camera points and world points."""
    rng = np.random.default_rng(seed)
    world = labs.places(rng, count, heights=options.pop("heights", labs.HEIGHTS))  # type: ignore[arg-type]
    points = labs.camera(rng).see(world, rng)
    tape, _ = labs.measure(world, rng)
    tape[:, 2] = world[:, 2]
    if callable(spoil):
        spoil(points, tape)
    rig: Rig = options.pop("rig", labs.RIG)  # type: ignore[assignment]
    write_log(path, labs.session({"red": points}, tape, rig, **options))  # type: ignore[arg-type]
    return path


def refused(ipsys: Ipsys, log: Path, *arguments: object) -> str:
    """Return the one line of a command; the log is unchanged."""
    before = log.read_bytes()
    done = ipsys(*arguments[:1], log, *arguments[1:])
    assert done.code == 1
    assert log.read_bytes() == before
    assert done.out == ""
    assert len(done.err.strip().splitlines()) == 1
    return done.err


def test_nan_in_an_import_is_refused_and_nothing_is_written(ipsys: Ipsys, data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "imsel"
    folder.mkdir()
    for path in (data / "imsel").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    training = scipy.io.loadmat(folder / "training_40.mat")
    training["Xw_white"][11, 1] = np.nan
    scipy.io.savemat(folder / "training_40.mat", {k: v for k, v in training.items() if k[0] != "_"})
    done = ipsys("import", "imsel", folder, "-o", tmp_path / "x.mcap")
    assert done.code == 1
    assert "Xw_white" in done.err
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.slow
def test_equal_heights_give_a_2d_model(ipsys: Ipsys, tmp_path: Path) -> None:
    log = made(tmp_path / "flat.mcap", heights=(0.1,))
    done = ipsys("evaluate", log, "--model", "poly", "--model", "best", "--json")
    assert "camera red: all calibration points have the height 10.0 cm" in done.err
    for name in ("poly", "best"):
        validated = json.loads(done.out)["models"][name]["cameras"]["red"]["cross_validation"]
        assert "3d" not in validated
        assert validated["2d"]["mean_m"] < 0.015
    assert ipsys("locate", log, "--model", "best").code == 0
    with Session([log]) as session:
        for payload in session.payloads(session.topics(POSITIONS, "best")):
            assert payload.positions[0].z_m == pytest.approx(0.1, abs=1e-6)


def test_model_with_known_heights_needs_them_in_the_rig(ipsys: Ipsys, tmp_path: Path) -> None:
    log = made(tmp_path / "lab.mcap")
    said = refused(ipsys, log, "replay", "--model", "rayplane")
    assert "the height of marker 0" in said
    assert "marker_height_m" in said
    # The points have their own heights, so the option changes nothing.
    assert ipsys("evaluate", log, "--model", "rayplane").code == 0
    rig = tmp_path / "lab.toml"
    rig.write_text(rig_toml(replace(labs.RIG, markers=(RigMarker(0, robot="ada", height_m=0.12),))))
    assert ipsys("replay", log, "--model", "rayplane", "--rig", rig).code == 0
    with Session([log]) as session:
        positions = session.payloads(session.topics(POSITIONS, "rayplane"))
    assert {round(p.positions[0].z_m, 9) for p in positions} == {0.12}
    assert np.sqrt(positions[0].positions[0].covariance_m2[2, 2]) < 0.002


def test_a_position_outside_the_measured_volume_says_so(tmp_path: Path) -> None:
    from ipsys_log.messages import CameraPoint, CameraPoints
    from ipsys_log.models.locate_points import LocatePoints
    from ipsys_log.statistics.camera_models import fit_model

    rng = np.random.default_rng(0)
    world, camera = labs.places(rng, 40), labs.camera(rng)
    tape, covariances = labs.measure(world, rng)
    locate = LocatePoints(
        fit_model("best", {"red": labs.pairs(camera.see(world, rng), tape, covariances)}, 0)
    )

    def inside(*place_m: float) -> bool | None:
        (seen,) = camera.see(np.array([place_m]), rng)
        points = CameraPoints(1, (CameraPoint(0, *seen.tolist()),))
        (found,) = locate(Message("t", 1, 1, points, "red"))
        flag: bool | None = found.positions[0].inside
        return flag

    assert inside(2.4, 0.9, 0.1) is True
    assert inside(2.4, 0.9, 0.5) is False  # above all measured points
    assert inside(2.4, -0.5, 0.1) is False
    assert inside(5.2, 0.9, 0.1) is False


@pytest.mark.slow
def test_a_model_out_of_a_log_predicts_what_it_predicted(ipsys: Ipsys, tmp_path: Path) -> None:
    """The tolerance is 1e-9 m, for every model in the table, by the numbers in the log."""
    from ipsys_log.models.rays import CalibrationPoints
    from ipsys_log.models.table import MODELS, AppliedModel, fit_cameras, inputs, predict_array

    log = made(tmp_path / "lab.mcap", labels=lambda n: ("train",))
    options = [option for name in MODELS for option in ("--model", name)]
    assert ipsys("fit", log, *options).code == 0
    with Session([log]) as session:
        models: list[Model] = [
            session.payloads([topic])[-1]
            for run in session.runs()
            for topic in session.topics(MODEL, run.run)
        ]
    assert {model.name for model in models} == set(MODELS)
    for model in models:
        (camera,) = model.cameras
        points = np.array([pair.camera_m for pair in camera.pairs])
        world = np.array([pair.world_m for pair in camera.pairs])
        places = CalibrationPoints(points, world, tuple(pair.measurement for pair in camera.pairs))
        fresh = fit_cameras(model.name, {"red": places})["red"]
        np.testing.assert_allclose(
            AppliedModel(model.name, camera).predict(points, world[:, 2]),
            predict_array(fresh, inputs(model.name, points, world[:, 2])),
            atol=1e-9,
        )


@pytest.mark.slow
def test_a_wrong_side_is_found_named_and_put_right(ipsys: Ipsys, tmp_path: Path) -> None:
    def other_side(points: np.ndarray, tape: np.ndarray) -> None:
        tape[13, 1] = 2 * labs.A[1] - tape[13, 1]

    log = made(tmp_path / "lab.mcap", spoil=other_side, distances=True)
    done = ipsys("evaluate", log, "--model", "best", "--json")
    (first, *_) = json.loads(done.out)["models"]["best"]["suspects"]
    assert (first["measurement"], first["kind"]) == ("m13", "side")


def test_imported_run_is_not_repeatable_and_later_ones_are(ipsys: Ipsys, data: Path, tmp_path: Path) -> None:
    log = tmp_path / "imsel.mcap"
    ipsys("import", "imsel", data / "imsel", "-o", log)
    assert ipsys("replay", log, "--model", "rigid").code == 0
    rows = json.loads(ipsys("runs", log, "--json").out)["rows"]
    states = {(row["run"], row["stage"]): row["state"] for row in rows}
    assert states.pop(("imsel", "import")) == "not repeatable"
    assert set(states.values()) == {"current"}
    verified = ipsys("verify", log)
    assert (verified.code, verified.err) == (0, "")
    assert "rigid/tracks" in verified.out
    assert "imsel" not in verified.out
