"""Faults of tilted markers and contradicted heights: see ``contradictions.py``."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from fault_trials import Fault, Outcome, Trial
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import find_board
from ipsys_log.calibration.images import find_sources
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CompressedImage, Message, Rig, RigMarker, Tracks
from ipsys_log.messages.channels import CAMERA_POINTS, POSITIONS
from ipsys_log.units import MM_PER_M
from ipsys_log.vision.lenses import undistort
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

__all__ = ["FAULTS"]

Array = NDArray[np.float64]

# 95 % of the errors in two dimensions have less than this chi2.
_REGION_95 = 5.99
_DRIVE = LabSettings(rate_hz=10.0, drive_s=45.0, markers=1, row_time_ns=31_000)
_DATA = Path(__file__).resolve().parent.parent / "../shared/data"
_BOARD = Board(4, 5, 0.054, 0.75, "DICT_4X4_1000", inverted=True)
_STEP_NS, _EVERY_FRAME, _LEAST_CORNERS = 50_000_000, 3, 8


def _lab(seed: int, wobble_deg: float = 0.2) -> GeometricLab:
    settings = GeometricSettings(
        lab=replace(_DRIVE, seed=seed),
        points=16,
        floor_rms_m=0.0005,
        wobble_deg=wobble_deg,
        marker_scale_sigma=0.001,
        robot_height_sigma_m=0.0005,
    )
    return build_lab(settings)


def _raised(lab: GeometricLab, raise_m: float) -> GeometricLab:
    """Return a lab whose robots carry their markers higher than its rig says, without calibration points."""
    heights_m = {number: height_m + raise_m for number, height_m in lab.robot_heights_m.items()}
    return replace(lab, robot_heights_m=heights_m, points=())


def _height(raise_m: float, *options: str, midway: bool = False) -> Callable[[Trial], Outcome]:
    """Return the trial of a lab whose robot carries its marker higher, from the middle of the drive on."""

    def try_once(trial: Trial) -> Outcome:
        lab = _lab(trial.seed)
        write_log(trial.folder / "lab.mcap", simulate_session(lab))
        drive = list(simulate_session(_raised(lab, raise_m)))
        if midway:
            before = list(simulate_session(_raised(lab, 0.0)))
            half_ns = (drive[0].log_time_ns + drive[-1].log_time_ns) // 2
            drive = [m for m in before if m.log_time_ns < half_ns]
            drive += [m for m in simulate_session(_raised(lab, raise_m)) if m.log_time_ns >= half_ns]
        write_log(trial.folder / "drive.mcap", drive)
        trial.ipsys("fit", "lab.mcap", *options)
        text = trial.ipsys("locate", "drive.mcap", *options, "--model-from", "lab.mcap")
        text += trial.ipsys("info", "drive.mcap")
        errors_mm, inside = _compare(trial.folder / "drive.mcap", _truth(drive))
        named = text.count("marker 0 is at 0.") >= 2
        return Outcome(named, float(np.median(errors_mm)), float(np.mean(inside)))

    return try_once


def _truth(messages: Sequence[Message]) -> tuple[Array, Array]:
    """Return the times (n,) in ns and the true places (n, 2) of the only robot."""
    rows = {
        m.payload.timestamp: (m.payload.tracks[0].x_m, m.payload.tracks[0].y_m)
        for m in messages
        if isinstance(m.payload, Tracks) and m.payload.tracks
    }
    return np.array(sorted(rows)), np.array([rows[time_ns] for time_ns in sorted(rows)])


def _compare(log: Path, truth: tuple[Array, Array]) -> tuple[list[float], list[bool]]:
    """Return the errors of positions in mm, and whether they are in the 95 % regions."""
    times_ns, places_m = truth
    errors_mm, inside = [], []
    with Session([log]) as session:
        topics = [topic for run in session.run_names() for topic in session.topics(POSITIONS, run)]
        for message in session.messages(topics):
            for position in message.payload.positions:
                at_ns = message.payload.timestamp + (position.time_offset_ns or 0)
                true_m = [np.interp(at_ns, times_ns, places_m[:, axis]) for axis in (0, 1)]
                away_m = np.array([position.x_m, position.y_m]) - true_m
                errors_mm.append(float(np.linalg.norm(away_m)) * MM_PER_M)
                chi2 = away_m @ np.linalg.solve(position.covariance_m2[:2, :2], away_m)
                inside.append(bool(chi2 < _REGION_95))
    return errors_mm, inside


def _tilted_tops(trial: Trial) -> Outcome:
    """Try tops that tilt by 8 degrees (RMS), with eq. (3)."""
    messages = simulate_session(_lab(trial.seed, wobble_deg=8.0))
    write_log(trial.folder / "lab.mcap", messages)
    text = trial.ipsys("replay", "lab.mcap", "--model", "rigid")
    drive = [m for m in simulate_session(_lab(trial.seed, wobble_deg=8.0)) if isinstance(m.payload, Tracks)]
    errors_mm, _ = _compare(trial.folder / "lab.mcap", _truth(drive))
    return Outcome("--method pose" in text, float(np.median(errors_mm)))


def _real_board(method: str) -> Callable[[Trial], Outcome]:
    """Return the trial of a real board: its markers against the pose of the board by other corners."""

    def try_once(trial: Trial) -> Outcome:
        folder = Path(os.environ.get("IPSYS_DATA", _DATA)).resolve() / "charuco_videos"
        if not folder.is_dir():
            raise SystemExit(f"no real data in {folder}: set IPSYS_DATA")
        log, lens = trial.folder / "board.mcap", _read_lens(folder)
        centres = dict(_board_centres(folder, lens))
        write_log(log, _board_messages(folder, lens))
        text = trial.ipsys("camera-frame", log.name, "--method", method)
        errors_mm, scores = [], []
        with Session([log]) as session:
            topics = [topic for run in session.run_names() for topic in session.topics(CAMERA_POINTS, run)]
            for message in session.messages(topics):
                for point in message.payload.points if message.payload.timestamp in centres else ():
                    away_m = np.array([point.x_m, point.y_m, point.z_m])
                    away_m -= centres[message.payload.timestamp][point.id]
                    errors_mm.append(float(np.linalg.norm(away_m)) * MM_PER_M)
                    scores.append(float(away_m @ np.linalg.solve(point.covariance_m2, away_m)))
        inside = float(np.mean(np.array(scores) < 7.81))
        figure = f"chi2/3 {np.mean(scores) / 3:.1f}"
        return Outcome("--method pose" in text, float(np.median(errors_mm)), inside, figure)

    return try_once


def _read_lens(folder: Path) -> CameraCalibration:
    row = tomllib.loads((folder / "camera_array.toml").read_text(encoding="utf-8"))["cameras"]["0"]
    (width, height), K, D = row["size"], np.array(row["matrix"]), np.array(row["distortions"])
    P = np.hstack([K, np.zeros((3, 1))])
    return CameraCalibration(0, "red", width, height, "plumb_bob", D, K, np.eye(3), P)


def _board_frames(folder: Path) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    (source,) = find_sources([folder / "cam_0.mp4"], [])
    for number, (_, grey) in enumerate(source.read()):
        if grey is not None and number % _EVERY_FRAME == 0:
            yield (number + 1) * _STEP_NS, grey


def _board_messages(folder: Path, lens: CameraCalibration) -> Iterator[Message]:
    markers = tuple(RigMarker(number) for number in range(10))
    yield Message("/rig", 1, 1, Rig("board", _BOARD.dictionary, 0.75 * 0.054, markers))
    yield Message("/cameras/red/calibration", 2, 2, lens, "red")
    for time_ns, grey in _board_frames(folder):
        image = CompressedImage(time_ns, "red", cv2.imencode(".png", 255 - grey)[1].tobytes(), "png")
        yield Message("/cameras/red/image", time_ns, time_ns, image, "red")


def _board_centres(folder: Path, lens: CameraCalibration) -> Iterator[tuple[int, Mapping[int, Array]]]:
    """Yield times with the centres of the markers in camera coordinates, from the pose of the whole board."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    board = cv2.aruco.CharucoBoard((4, 5), 0.054, 0.75 * 0.054, known)
    squares_m = np.array(board.getObjPoints(), dtype=np.float64).mean(axis=1) - [0.108, 0.135, 0]
    for time_ns, grey in _board_frames(folder):
        seen = find_board("frame", grey, _BOARD, thorough=False)
        if seen is not None and len(seen.ids) >= _LEAST_CORNERS:
            points_m = _BOARD.points_m(np.array(seen.ids))
            uv = undistort(np.asarray(seen.pixels, dtype=np.float64), lens)
            _, turn, shift_m = cv2.solvePnP(points_m, uv, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
            turn, shift_m = cv2.solvePnPRefineLM(points_m, uv, np.eye(3), None, turn, shift_m)
            centres_m = squares_m @ cv2.Rodrigues(turn)[0].T + np.ravel(shift_m)
            yield time_ns, dict(zip(np.ravel(board.getIds()).tolist(), centres_m, strict=True))


_JOINT, _RAYPLANE = ("--model", "joint"), ("--model", "rayplane", "--method", "pose")
FAULTS: Sequence[Fault] = (
    Fault("marker 3 cm higher than the rig, joint", _height(0.03, *_JOINT), is_random=True),
    Fault("marker 1 cm lower than the rig, joint", _height(-0.01, *_JOINT), is_random=True),
    Fault("marker 5 cm higher midway, joint", _height(0.05, *_JOINT, midway=True), is_random=True),
    Fault("marker 3 cm higher than the rig, rayplane", _height(0.03, *_RAYPLANE), is_random=True),
    Fault("tops tilted by 8 degrees, eq. (3)", _tilted_tops, is_random=True),
    Fault("real board, tilted, eq. (3)", _real_board("perimeter")),
    Fault("real board, tilted, pose: its covariance", _real_board("pose")),
)
