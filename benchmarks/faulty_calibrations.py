"""Faults of files of camera intrinsics: see ``contradictions.py``.

Each trial draws a lens and 60 poses of a marker, projects the corners with 0.05 px of noise into
a table of detections, and gives the table and a faulty file to ``import detections`` and ``camera-frame``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from fault_trials import Fault, Outcome, Trial, cases_folder
from numpy.typing import ArrayLike, NDArray

from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration
from ipsys_log.messages.channels import CAMERA_POINTS
from ipsys_log.vision.lenses import project

__all__ = ["FAULTS"]

_SIZE_PX = (1280, 720)
_SIDE_M = 0.15
_POSES = 60
_CORNER_SIGMA_PX = 0.05
_CHI2_95 = 7.815  # of three degrees of freedom
_RIG = f"""name = "lab"
dictionary = "DICT_4X4_50"
marker_length_m = {_SIDE_M}
[[cameras]]
name = "red"
"""
_HEADER = "time,camera,marker_id," + ",".join(f"{axis}{corner}_px" for corner in range(4) for axis in "xy")
# Files of cases/calibration that cannot be read: each needs a reason, and a line except for the rig files.
_UNREADABLE = {
    **dict.fromkeys(("camchain-ds.yaml", "camchain-eucm.yaml", "camchain-omni.yaml"), ("line 3", "model")),
    **dict.fromkeys(("echo_skew.yaml", "skew_opencv.yaml"), ("line", "skew")),
    **dict.fromkeys(("half_centre.yaml", "openicc_half.json"), ("line", "principal point")),
    **dict.fromkeys(("nosize.yaml", "printed.yaml"), ("line", "image size is missing")),
    **dict.fromkeys(("lab.toml", "lab15.toml"), ("is a rig file",)),
    "folding_opencv.yaml": ("line", "turns back"),
    "komma.yaml": ("line 5", "decimal points"),
    "ros_fisheye_k0.yaml": ("line", "not calibrated"),
    "ros_rational_d5.yaml": ("line", "plumb_bob takes 5 coefficients, found 8"),
    "rows_swapped.yaml": ("line", "exchange width and height"),
}


def _draw_lens(rng: np.random.Generator, model: str) -> CameraCalibration:
    focal_px = rng.uniform(700, 800)
    K = np.array([[focal_px, 0, 640 + rng.normal(0, 8)], [0, focal_px, 360 + rng.normal(0, 8)], [0, 0, 1]])
    D = np.array([-0.02, 0.003, -0.001, 0.0002] if model == "kannala_brandt" else [-0.25, 0.08, 0, 0, 0])
    return CameraCalibration(0, "red", *_SIZE_PX, model, D, K)


def _draw_table(rng: np.random.Generator, lens: CameraCalibration) -> tuple[str, NDArray[np.float64]]:
    """Return a table of detections, and the centres of the markers in camera coordinates, (n, 3), in m."""
    square_m = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * [1, -1, 0] * _SIDE_M / 2
    centres_m = rng.uniform([-0.8, -0.4, 1.5], [0.8, 0.4, 2.5], (_POSES, 3))
    rows = [_HEADER]
    for second, centre_m in enumerate(centres_m):
        angle = rng.uniform(-np.pi, np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        corners_px = project(square_m @ turn.T + centre_m, lens)
        corners_px += rng.normal(0, _CORNER_SIGMA_PX, corners_px.shape)
        numbers = ",".join(f"{value:.4f}" for value in corners_px.ravel())
        rows.append(f"{1_700_000_000 + second},red,1,{numbers}")
    return "\n".join(rows) + "\n", centres_m


def _text(K: NDArray[np.float64], D: ArrayLike, model: str, size_px: tuple[int, int] = _SIZE_PX) -> str:
    stated = f"distortion_model: {model}\n" if model else ""
    matrix = f"camera_matrix: {{rows: 3, cols: 3, data: {np.asarray(K).ravel().tolist()}}}\n"
    row = np.asarray(D).tolist()
    matrix += f"distortion_coefficients: {{rows: 1, cols: {len(row)}, data: {row}}}\n"
    return f"image_width: {size_px[0]}\nimage_height: {size_px[1]}\n{matrix}{stated}"


Write = Callable[[CameraCalibration], str]


def _try_file(write: Write, said: str, trial: Trial, model: str = "kannala_brandt") -> Outcome:
    rng = np.random.default_rng(trial.seed)
    lens = _draw_lens(rng, model)
    table, centres_m = _draw_table(rng, lens)
    for name, text in (("lab.toml", _RIG), ("a.csv", table), ("red.yaml", write(lens))):
        (trial.folder / name).write_text(text)
    log = trial.folder / "a.mcap"
    output = trial.ipsys(
        *("import", "detections", "a.csv", "-o", log, "--rig", "lab.toml", "--calibration", "red=red.yaml")
    )
    if not log.exists():
        return Outcome(said in output, figure="refused" if said in output else output.strip()[-60:])
    output += trial.ipsys("camera-frame", log, "--method", "pose")
    return _compare(log, centres_m, said in output)


def _compare(log: Path, centres_m: NDArray[np.float64], is_named: bool) -> Outcome:
    with Session([log]) as session:
        topics = [topic for run in session.run_names() for topic in session.topics(CAMERA_POINTS, run)]
        frames = session.payloads(topics)
    errors_mm, inside = [], []
    for frame, centre_m in zip(frames, centres_m, strict=True):
        for point in frame.points:
            error_m = np.array([point.x_m, point.y_m, point.z_m]) - centre_m
            errors_mm.append(1000 * float(np.linalg.norm(error_m)))
            if point.covariance_m2 is not None:
                inside.append(float(error_m @ np.linalg.solve(point.covariance_m2, error_m)) <= _CHI2_95)
    median_mm = float(np.median(errors_mm)) if errors_mm else None
    return Outcome(is_named, median_mm, float(np.mean(inside)) if inside else None)


def _changed(row: int, column: int, value: float) -> Write:
    def write(lens: CameraCalibration) -> str:
        K = lens.K.copy()
        K[row, column] = value
        return _text(K, lens.D, "fisheye")

    return write


def _half_centre(lens: CameraCalibration) -> str:
    K = lens.K.copy()
    K[:2] /= 2
    return _text(K, lens.D, "fisheye")


def _try_cases(trial: Trial) -> Outcome:
    """Give each shared calibration file to a command: is it read, or refused with a line and the reason?"""
    rng = np.random.default_rng(trial.seed)
    (trial.folder / "lab.toml").write_text(_RIG)
    (trial.folder / "a.csv").write_text(_draw_table(rng, _draw_lens(rng, "plumb_bob"))[0])
    paths = sorted((cases_folder() / "calibration").iterdir())
    wrong = []
    for path in paths:
        log = trial.folder / f"{path.name}.mcap"
        output = trial.ipsys(
            *("import", "detections", "a.csv", "-o", log, "--rig", "lab.toml", "--calibration", f"red={path}")
        )
        reasons = _UNREADABLE.get(path.name)
        is_right = log.exists() if reasons is None else all(reason in output for reason in reasons)
        wrong += [] if is_right and (reasons is None or not log.exists()) else [path.name]
    return Outcome(not wrong, figure=f"{len(paths) - len(wrong)} of {len(paths)} files answered rightly")


def _try_rig_file(trial: Trial) -> Outcome:
    """Import detections with a calibration that only the rig names."""
    rng = np.random.default_rng(trial.seed)
    lens = _draw_lens(rng, "kannala_brandt")
    table, centres_m = _draw_table(rng, lens)
    rig = _RIG + 'calibration = "red.yaml"\n'
    for name, text in (("lab.toml", rig), ("a.csv", table), ("red.yaml", _text(lens.K, lens.D, "fisheye"))):
        (trial.folder / name).write_text(text)
    log = trial.folder / "a.mcap"
    output = trial.ipsys("import", "detections", "a.csv", "-o", log, "--rig", "lab.toml")
    if not log.exists():
        return Outcome(False, figure="refused: has no intrinsics" if "no intrinsics" in output else output)
    trial.ipsys("camera-frame", log, "--method", "pose")
    return _compare(log, centres_m, True)


def _fault(name: str, write: Write, said: str, model: str = "kannala_brandt") -> Fault:
    return Fault(f"calibration file: {name}", partial(_try_file, write, said, model=model), is_random=True)


FAULTS: Sequence[Fault] = (
    _fault("camera matrix transposed", lambda lens: _text(lens.K.T, lens.D, "fisheye"), "is transposed"),
    _fault("K[1, 0] is not 0", _changed(1, 0, 12.0), "K[1, 0]"),
    _fault("last row is not 0 0 1", _changed(2, 2, 2.0), "last row"),
    _fault("skew of 20 px", _changed(0, 1, 20.0), "skew"),
    _fault("values of half-size images", _half_centre, "principal point"),
    _fault(
        "width and height exchanged", lambda lens: _text(lens.K, lens.D, "fisheye", (720, 1280)), "exchange"
    ),
    _fault(
        "focal length in mm",
        lambda lens: _text(lens.K * [[0.005], [0.005], [1]], lens.D, "fisheye"),
        "pixels",
    ),
    _fault(
        "lens curve turns back",
        lambda lens: _text(lens.K, [-1.152516, 2.913204, -2.482336, 0.178503], "fisheye"),
        "turns back",
    ),
    _fault(
        "four coefficients, no model",
        lambda lens: _text(lens.K, lens.D[:4], ""),
        "does not state its lens model",
        "plumb_bob",
    ),
    Fault("calibration files of other programs", _try_cases),
    Fault("import detections: calibration of the rig", _try_rig_file, is_random=True),
)
