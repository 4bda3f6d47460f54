"""Value of frame times on real images: cameras from the videos of a hand-held ChArUco board.

    python benchmarks/charuco_videos.py                     # a table of errors
    python benchmarks/charuco_videos.py --picture errors.png

Four webcams saw one board. The frames of a synchronisation index are up to 10 ms apart by their stamps. The
simultaneous model has one pose of the board for each index, and the intrinsics of the reference. The timed
model is that of ``calibrate-lab --board``: a path of the board, the jitter of the stamps, and for each camera
a clock offset, a row time and intrinsics. A held-out error comes from a fit without those frames: half of the
frames of one camera. The path comes from the other cameras, and the pose of the camera from its other half.
The script writes JSON with -o.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from charuco_figure import draw_errors
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import LEAST_CORNERS, find_board
from ipsys_log.calibration.images import find_sources
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hand_held import fit_hand_held, fit_motion
from ipsys_log.calibration.joint.held_out import corner_sigma, distance_errors, predict_errors
from ipsys_log.calibration.joint.observations import (
    Body,
    CalibrationPoint,
    CameraPrior,
    Observations,
    Sightings,
)
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.messages import CameraCalibration
from ipsys_log.tools.carried_lab import BOARD_SETTINGS
from ipsys_log.vision.poses import make_pose

__all__ = ["BoardVideos", "measure", "read_videos"]

Array = NDArray[np.float64]
Figures = dict[str, Any]

_BOARD = Board(4, 5, 0.054, 0.75, "DICT_4X4_1000", inverted=True)
_CORNERS = 12
# The intrinsics are those of the reference. The clocks are unknown.
_SETTINGS = JointSettings(
    focal_sigma=0.0,
    centre_sigma=0.0,
    distortion_sigma=0.0,
    edge_sigma_px=0.0,
    corner_floor_px=0.0,
    clock_sigma_s=0.2,
)
_FIRST_SIGMA_PX = 1.0
_MS, _MM = 1e3, 1e3


@dataclass(frozen=True, slots=True, eq=False)
class BoardVideos:
    """The board in the frames of c cameras, with the reference calibration.

    ``indices`` (c lists of (n,)) are the synchronisation indices of the sightings, from 0. ``reference`` is
    ``camera_from_world`` (4, 4) of each camera.
    """

    cameras: tuple[CameraPrior, ...]
    sightings: tuple[Sightings, ...]
    indices: tuple[NDArray[np.intp], ...]
    reference: tuple[Array, ...]

    def observe(self, timed: bool, sigma_px: float, masks: Sequence[NDArray[np.bool_]]) -> Observations:
        """Return the sightings in ``masks`` with a corner error of ``sigma_px``."""
        covariance = sigma_px**2 * np.eye(2 * _CORNERS)
        parts = []
        used = np.unique(
            np.concatenate([indices[mask] for indices, mask in zip(self.indices, masks, strict=True)])
        )
        for own, indices, mask in zip(self.sightings, self.indices, masks, strict=True):
            numbers = np.full(len(own), -1) if timed else np.searchsorted(used, indices)
            covariances = np.tile(covariance, (len(own), 1, 1))
            parts.append(replace(own, point=numbers, covariances_px2=covariances).select(mask))
        points = () if timed else tuple(CalibrationPoint(str(n), 0) for n in used.tolist())
        cameras = tuple(replace(own, row_time_s=None if timed else 0.0) for own in self.cameras)
        body = Body("board", _BOARD.points_m(np.arange(_CORNERS)), 0.0)
        return Observations(cameras, (body,), points, tuple(parts))

    @property
    def every(self) -> list[NDArray[np.bool_]]:
        """Masks of all sightings."""
        return [np.ones(len(own), dtype=np.bool_) for own in self.sightings]

    @property
    def step_s(self) -> float:
        """The usual time between two frames of a camera."""
        return float(np.median(np.concatenate([np.diff(own.times_s) for own in self.sightings])))


def read_videos(folder: Path) -> BoardVideos:
    """Detect the board in the videos of a folder; keep indices at which at least two cameras see it."""
    reference = tomllib.loads((folder / "camera_array.toml").read_text(encoding="utf-8"))["cameras"]
    names = sorted(reference)
    with (folder / "timestamps.csv").open(newline="", encoding="utf-8") as file:
        rows = sorted(csv.DictReader(file), key=lambda row: int(row["frame_index"]))
    views = []
    for name in names:
        stamps = [row for row in rows if row["cam_id"] == name]
        views.append(_read_views(folder / f"cam_{name}.mp4", stamps))
    seen = np.bincount([index for own in views for index in own])
    shared = np.flatnonzero(seen >= 2)
    start_s = min(own[index][0] for own in views for index in own)
    parts = [[(int(n), *own[i]) for n, i in enumerate(shared.tolist()) if i in own] for own in views]
    return BoardVideos(
        tuple(_camera(f"cam_{name}", reference[name]) for name in names),
        tuple(_sightings(own, start_s) for own in parts),
        tuple(np.array([row[0] for row in own], dtype=np.intp) for own in parts),
        tuple(
            make_pose(np.array(reference[name]["rotation"]), np.array(reference[name]["translation"]))
            for name in names
        ),
    )


def _read_views(video: Path, stamps: Sequence[dict[str, str]]) -> dict[int, tuple[float, Array]]:
    """Return time in s and corners (12, 2) in px of each frame with enough corners, by index."""
    views = {}
    (source,) = find_sources([video], [])
    for stamp, (name, grey) in zip(stamps, source.read(), strict=True):
        sighting = None if grey is None else find_board(name, grey, _BOARD, thorough=False)
        if sighting is not None and len(sighting.ids) >= LEAST_CORNERS:
            pixels = np.full((_CORNERS, 2), np.nan)
            pixels[sighting.ids] = sighting.pixels
            views[int(stamp["sync_index"])] = float(stamp["frame_time"]), pixels
    return views


def _sightings(rows: Sequence[tuple[int, float, Array]], start_s: float) -> Sightings:
    none = np.zeros(len(rows), dtype=np.intp)
    times_s = np.array([time_s - start_s for _, time_s, _ in rows])
    covariances = np.zeros((len(rows), 2 * _CORNERS, 2 * _CORNERS))
    return Sightings(none, none - 1, times_s, np.array([pixels for _, _, pixels in rows]), covariances)


def _camera(name: str, reference: Figures) -> CameraPrior:
    (width, height), D, K = reference["size"], reference["distortions"], reference["matrix"]
    lens = CameraCalibration(0, name, width, height, "plumb_bob", np.array(D), np.array(K))
    return CameraPrior(name, lens)


@dataclass(frozen=True, slots=True)
class _Model:
    """A model of the instants of the frames; ``known`` camera poses are those of the reference."""

    name: str
    timed: bool
    known: bool = False

    def fit(
        self,
        videos: BoardVideos,
        sigma_px: float,
        masks: Sequence[NDArray[np.bool_]],
        settings: JointSettings = _SETTINGS,
    ) -> JointFit:
        observations = videos.observe(self.timed, sigma_px, masks)
        poses = videos.reference if self.known else None
        # Half of the interval between frames: a path with fewer knots cannot follow a hand.
        return fit_hand_held(observations, settings, videos.step_s / 2, camera_poses=poses)

    def fit_all(self, videos: BoardVideos) -> tuple[JointFit, float]:
        """Return the fit to all sightings, and the standard deviation of a corner in px that it gives."""
        sigma_px, settings = _FIRST_SIGMA_PX, BOARD_SETTINGS if self.timed else _SETTINGS
        for _ in range(3):
            fit = self.fit(videos, sigma_px, videos.every, settings)
            fit = fit_motion(fit) if self.timed else fit
            settings = fit.settings
            sigma_px = corner_sigma(fit) if self.timed else _rms(_errors(fit)) / np.sqrt(2)
        return fit, sigma_px

    def hold_out(self, videos: BoardVideos, sigma_px: float, settings: JointSettings) -> list[Array]:
        """Return the errors (n, 12, 2) of the frames of each camera that a fit does not use."""
        errors = []
        for camera, own in enumerate(videos.sightings):
            first = np.arange(len(own)) < len(own) // 2
            parts = []
            for out in (first, ~first):
                masks = videos.every
                masks[camera] = ~out
                fit = self.fit(videos, sigma_px, masks, settings)
                held_out = videos.observe(self.timed, sigma_px, videos.every).sightings[camera].select(out)
                parts.append(predict_errors(fit, camera, held_out))
            errors.append(np.concatenate(parts))
        return errors


_MODELS = (
    _Model("reference", timed=False, known=True),
    _Model("simultaneous", timed=False),
    _Model("timed", timed=True),
)


def _fit_views_alone(videos: BoardVideos) -> list[Array]:
    """Return the errors of each camera with one pose of the board for each of its images."""
    errors = []
    for camera in range(len(videos.sightings)):
        masks = [np.full(len(own), n == camera) for n, own in enumerate(videos.sightings)]
        errors.append(_errors(_MODELS[0].fit(videos, _FIRST_SIGMA_PX, masks))[camera])
    return errors


def _errors(fit: JointFit) -> list[Array]:
    """Return the reprojection errors (n, 12, 2) in px of the sightings of each camera."""
    sightings = fit.observations.sightings
    return [
        predict_errors(fit, n, own) if len(own) else np.zeros((0, _CORNERS, 2))
        for n, own in enumerate(sightings)
    ]


def _lengths(errors: Sequence[Array]) -> Array:
    lengths = np.concatenate([np.linalg.norm(one, axis=2).ravel() for one in errors])
    return np.asarray(lengths[np.isfinite(lengths)])


def _rms(errors: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(_lengths(errors) ** 2)))


def _summary(errors: Sequence[Array]) -> Figures:
    return {
        "rmse_px": _rms(errors),
        "median_px": float(np.median(_lengths(errors))),
        "by_camera_px": [_rms([one]) for one in errors],
    }


def _poses(fit: JointFit) -> list[Array]:
    """Return ``camera_from_world`` (4, 4) of each camera."""
    poses = []
    for block, turn in zip(fit.problem.layout.cameras, fit.state.camera_turns, strict=True):
        poses.append(make_pose(turn, -turn @ fit.state.values[block.start + 3 : block.start + 6]))
    return poses


def _differences(poses: Sequence[Array], reference: Sequence[Array]) -> Figures:
    """Return differences between pairs of cameras: of distances in per cent, of turns in degrees."""
    distances, turns = [], []
    for first in range(len(poses)):
        for second in range(first):
            own, other = (some[first] @ np.linalg.inv(some[second]) for some in (poses, reference))
            distances.append(100 * (np.linalg.norm(own[:3, 3]) / np.linalg.norm(other[:3, 3]) - 1))
            turn = Rotation.from_matrix(own[:3, :3] @ other[:3, :3].T)
            turns.append(np.degrees(turn.magnitude()))
    return {"distances_percent": [float(d) for d in distances], "turns_deg": [float(t) for t in turns]}


def _clocks(fit: JointFit) -> Figures:
    columns = [block.edge + 1 for block in fit.problem.layout.cameras]
    return {
        "clocks_ms": (_MS * fit.state.values[columns]).tolist(),
        "clock_sigmas_ms": (_MS * np.sqrt(fit.covariance.diagonal()[columns])).tolist(),
    }


def _agreement(model: _Model, videos: BoardVideos, sigma_px: float, settings: JointSettings) -> Figures:
    """Compare fits to the odd and to the even indices, by camera poses and clocks."""
    odd, even = (
        model.fit(videos, sigma_px, [indices % 2 == side for indices in videos.indices], settings)
        for side in (1, 0)
    )
    blocks = odd.problem.layout.cameras[1:]
    columns = np.concatenate([[*range(b.start, b.start + 6), *[b.edge + 1] * model.timed] for b in blocks])
    difference = odd.state.values - even.state.values
    pairs = zip(blocks, odd.state.camera_turns[1:], even.state.camera_turns[1:], strict=True)
    for block, one, other in pairs:
        difference[block.start : block.start + 3] = Rotation.from_matrix(one @ other.T).as_rotvec()
    covariance = (odd.covariance + even.covariance)[np.ix_(columns, columns)]
    step = difference[columns]
    in_sigmas = step / np.sqrt(covariance.diagonal())
    return {
        "unknowns": len(columns),
        "rms_in_sigmas": float(np.sqrt(np.mean(in_sigmas**2))),
        "largest_in_sigmas": float(np.abs(in_sigmas).max()),
        "chi2_per_unknown": float(step @ np.linalg.solve(covariance, step)) / len(columns),
        "position_mm": [_MM * float(np.linalg.norm(difference[b.start + 3 : b.start + 6])) for b in blocks],
        "clock_ms": [_MS * float(difference[b.edge + 1]) for b in blocks],
    }


def measure(videos: BoardVideos) -> Figures:
    """Fit the models, and return their errors."""
    figures: Figures = {
        "cameras": [camera.name for camera in videos.cameras],
        "views": [len(own) for own in videos.sightings],
        "step_s": videos.step_s,
        "alone": {"in_sample": _summary(_fit_views_alone(videos))},
    }
    for model in _MODELS:
        fit, sigma_px = model.fit_all(videos)
        own = figures[model.name] = {"sigma_px": sigma_px, "in_sample": _summary(_errors(fit))}
        if model.known:
            continue
        own["reference"] = _differences(_poses(fit), videos.reference)
        own["held_out"] = _summary(model.hold_out(videos, sigma_px, fit.settings))
        own["odd_even"] = _agreement(model, videos, sigma_px, fit.settings)
        if model.timed:
            own |= _clocks(fit)
            own["row_times_us"] = [
                1e6 * float(fit.state.values[block.edge + 2]) for block in fit.problem.layout.cameras
            ]
            own["jitter_ms"] = _MS * fit.settings.stamp_jitter_s
            own["square_errors_mm"] = (_MM * distance_errors(fit)).tolist()
    return figures


def _print(figures: Figures) -> None:
    print(f"{sum(figures['views'])} views, {', '.join(figures['cameras'])}: {figures['views']}")
    print(f"\n{'errors in px':<28}{'RMSE':>7}{'median':>8}   RMSE of each camera")
    for name in ("alone", *(model.name for model in _MODELS)):
        for part in ("in_sample", "held_out"):
            if errors := figures[name].get(part):
                cameras = "".join(f"{one:>7.2f}" for one in errors["by_camera_px"])
                title = f"{name}, {part.replace('_', ' ')}"
                print(f"{title:<28}{errors['rmse_px']:>7.2f}{errors['median_px']:>8.2f}   {cameras}")
    for model in _MODELS[1:]:
        own = figures[model.name]
        reference, halves = own["reference"], own["odd_even"]
        distance = max(map(abs, reference["distances_percent"]))
        print(
            f"\n{model.name}, from the reference: distances between cameras up to {distance:.1f} %,", end=""
        )
        print(f" rotations up to {max(reference['turns_deg']):.1f} degrees")
        print(f"  odd and even indices: {halves['rms_in_sigmas']:.1f} sigmas (RMS),", end="")
        print(f" at most {halves['largest_in_sigmas']:.1f}, {max(halves['position_mm']):.1f} mm")
    timed = figures["timed"]
    clocks = zip(figures["cameras"], timed["clocks_ms"], timed["clock_sigmas_ms"], strict=True)
    rms_mm = float(np.sqrt(np.mean(np.square(timed["square_errors_mm"]))))
    print(f"\nsquares at held-out instants: RMS error {rms_mm:.2f} mm; jitter {timed['jitter_ms']:.0f} ms")
    print("row times in us:", ", ".join(f"{one:.1f}" for one in timed["row_times_us"]))
    print("clock offsets in ms:", ", ".join(f"{n} {c:.1f} +- {s:.1f}" for n, c, s in clocks))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    parser.add_argument("--picture", type=Path, help="figure of the errors and the clock offsets to write")
    options = parser.parse_args()
    folder = Path(os.environ.get("IPSYS_DATA", "../shared/data")) / "charuco_videos"
    if not folder.is_dir():
        raise SystemExit(f"no real data in {folder}: set IPSYS_DATA (docs/data.md says where to get them)")
    with threadpool_limits(1):
        figures = measure(read_videos(folder))
    _print(figures)
    if options.output:
        options.output.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    if options.picture:
        draw_errors(options.picture, figures)


if __name__ == "__main__":
    main()
