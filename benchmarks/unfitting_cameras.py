"""Cameras whose images do not fit their calibration: see ``contradictions.py``.

The images are those of the rendered sample log. Random labs have markers on a floor, without images.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from fault_trials import Fault, Outcome, Trial
from numpy.typing import NDArray

from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration
from ipsys_log.messages.channels import CALIBRATIONS, POSITIONS, RIG, TRUTH
from tests.analysis.marked_floor import FISHEYE, calibrated_with_errors, changed, sighted

__all__ = ["FAULTS"]

_ROOT = Path(__file__).resolve().parent.parent

_SAMPLE = _ROOT / "sample_logs/small_lab.mcap"
_CHI2_95 = 7.815  # of three coordinates
_SAME_INSTANT_NS = 1_000_000
_NAMED = "do not fit its calibration"
_REFUSED = "calibrate at the size of the recorded images"


def _yaml(path: Path, lens: CameraCalibration) -> None:
    K, D = lens.K.ravel().tolist(), lens.D.ravel().tolist()
    model = "equidistant" if lens.distortion_model == "kannala_brandt" else lens.distortion_model
    path.write_text(
        f"image_width: {lens.width}\nimage_height: {lens.height}\ndistortion_model: {model}\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(D)}, data: {D}}}\n"
    )


def _replay(
    change: Callable[[Mapping[str, CameraCalibration]], Mapping[str, CameraCalibration]], trial: Trial
) -> Outcome:
    """Replay the sample log with other intrinsics."""
    with Session([_SAMPLE]) as session:
        topics = {topic.split("/")[2]: topic for topic in session.topics(CALIBRATIONS)}
        lenses = {camera: session.payloads([topic])[0] for camera, topic in topics.items()}
    options: list[str] = []
    for camera, lens in change(lenses).items():
        _yaml(trial.folder / f"{camera}.yaml", lens)
        options += ["--calibration", f"{camera}={camera}.yaml"]
    output = trial.ipsys("replay", _SAMPLE, "-o", "out.mcap", "--model", "rigid", *options)
    if _REFUSED in output:
        return Outcome(True, figure="refused")
    errors_m, inside, certain = _errors(trial.folder / "out.mcap")
    named = len(set(re.findall(rf"camera (\w+): markers {_NAMED}", output)))
    changed_lenses = sum(lens is not lenses[camera] for camera, lens in change(lenses).items())
    return Outcome(
        named == changed_lenses,
        1000 * float(np.median(errors_m)) if len(errors_m) else None,
        float(inside.mean()) if len(errors_m) else None,
        f"{named} of {changed_lenses} cameras named; {certain:.0%} of the positions are inside",
    )


def _errors(path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
    """Return true errors in m, whether they are in the stated 95 % region, and the share of ``inside``."""
    certain: list[bool] = []
    errors_m: list[float] = []
    inside: list[bool] = []
    if not path.exists():
        return np.array(errors_m), np.array(inside, dtype=bool), 0.0
    with Session([_SAMPLE, path]) as session:
        truth = session.payloads(session.topics(TRUTH))
        times_ns = np.array([tracks.timestamp for tracks in truth])
        rig = session.payloads(session.topics(RIG))[0]
        for positions in session.payloads(session.topics(POSITIONS, "rigid")):
            n = int(np.abs(times_ns - positions.timestamp).argmin())
            if abs(int(times_ns[n]) - positions.timestamp) > _SAME_INSTANT_NS:
                continue
            robots = {track.robot: track for track in truth[n].tracks}
            for position in positions.positions:
                track = robots.get(rig.robot_of(position.id))
                if track is None or position.covariance_m2 is None:
                    continue
                off_m = np.array(
                    [position.x_m - track.x_m, position.y_m - track.y_m, position.z_m - track.z_m]
                )
                errors_m.append(float(np.linalg.norm(off_m)))
                certain.append(bool(position.inside))
                inside.append(float(off_m @ np.linalg.solve(position.covariance_m2, off_m)) < _CHI2_95)
    share = float(np.mean(certain)) if certain else 0.0
    return np.array(errors_m), np.array(inside, dtype=bool), share


def _import(
    trial: Trial, change: Callable[[CameraCalibration], CameraCalibration], length_m: float = 0.2
) -> str:
    """Import markers that another camera has seen, and compute their camera points; return the output."""
    random = np.random.default_rng(trial.seed)
    frames = sighted(FISHEYE, random, lengths_m=(0.2, length_m, 0.2))
    _yaml(trial.folder / "red.yaml", change(calibrated_with_errors(FISHEYE, random)))
    (trial.folder / "lab.toml").write_text(
        'name = "lab"\ndictionary = "DICT_4X4_50"\nmarker_length_m = 0.2\nmarker_height_m = 0.1\n\n'
        + "".join(f'[[markers]]\nid = {n}\nrobot = "robot_{n}"\n\n' for n in range(3))
        + '[[cameras]]\nname = "red"\n'
    )
    names = ",".join(f"{axis}{corner}_px" for corner in range(4) for axis in "xy")
    rows = [
        ",".join(map(str, (f"{1_700_000_000 + second}", "red", marker.id, *marker.corners_px.ravel())))
        for second, markers in enumerate(frames)
        for marker in markers
    ]
    (trial.folder / "markers.csv").write_text("\n".join([f"time,camera,marker_id,{names}", *rows]) + "\n")
    imported = trial.ipsys(
        *("import", "detections", "markers.csv", "-o", "log.mcap", "--rig", "lab.toml"),
        *("--calibration", "red=red.yaml"),
    )
    return imported + trial.ipsys("camera-frame", "log.mcap")


def _seen(change: Callable[[CameraCalibration], CameraCalibration], trial: Trial) -> Outcome:
    return Outcome(_NAMED in _import(trial, change))


def _honest(trial: Trial) -> Outcome:
    output = _import(trial, lambda lens: lens)
    return Outcome("camera red:" not in output, figure="" if "markers: 1" in output else output[-200:])


def _short(trial: Trial) -> Outcome:
    return Outcome("camera red: marker 1 looks" in _import(trial, lambda lens: lens, 0.19))


def _all(change: Callable[[CameraCalibration], CameraCalibration]) -> Callable[[Trial], Outcome]:
    return partial(_replay, lambda lenses: {camera: change(lens) for camera, lens in lenses.items()})


def _half_centre(lens: CameraCalibration) -> CameraCalibration:
    return replace(lens, K=lens.K * [[1, 1, 0.5], [1, 1, 0.5], [1, 1, 1]])


def _half_size(lens: CameraCalibration) -> CameraCalibration:
    return replace(lens, K=lens.K * [[0.5], [0.5], [1]])


def _pinhole(lens: CameraCalibration) -> CameraCalibration:
    return replace(lens, distortion_model="plumb_bob", D=np.append(lens.D, 0.0))


def _exchanged(lenses: Mapping[str, CameraCalibration]) -> Mapping[str, CameraCalibration]:
    """Return the intrinsics of two cameras with lenses of 1160 px and 1276 px, exchanged."""
    first, second, *_ = sorted(lenses)
    return {**lenses, first: changed(lenses[second], f=1.1), second: changed(lenses[first], f=1 / 1.1)}


FAULTS: Sequence[Fault] = (
    Fault("calibration: zoom 10 %", _all(partial(changed, f=1.1))),
    Fault("calibration: zoom 4 %", _all(partial(changed, f=1.04))),
    Fault("calibration: centre of half-size images", _all(_half_centre)),
    Fault("calibration: of half-size images", _all(_half_size)),
    Fault("calibration: fisheye coefficients as pinhole", _all(_pinhole)),
    Fault("calibration: two cameras exchanged", partial(_replay, _exchanged)),
    Fault("calibration: zoom 10 %, tilted tops", partial(_seen, partial(changed, f=1.1)), True),
    Fault("calibration: aspect 5 %, tilted tops", partial(_seen, partial(changed, fy=1.05)), True),
    Fault("marker: one of three is 5 % shorter", _short, True),
    Fault("honest calibration (named: no remark)", _honest, True),
)
