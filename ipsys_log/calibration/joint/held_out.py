"""Errors of cameras that a hand-held body has calibrated: in held-out frames, and of distances on a board."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hand_held import fit_hand_held, fit_path
from ipsys_log.calibration.joint.hand_held_start import SAME_TIME_S, covers, path_at
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.calibration.joint.observations import Observations, Sightings
from ipsys_log.calibration.joint.sighting_factors import make_sighting_factors
from ipsys_log.calibration.joint.trajectories import Kind
from ipsys_log.calibration.lens_models import project_points
from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.vision.lenses import undistort

# The 90th percentile of chi2 of four corners, for each coordinate.
_USUAL_CHI2 = 1.67


def predict_errors(fit: JointFit, camera: int, sightings: Sightings) -> Array:
    """Return the reprojection errors of sightings, also of those that the fit did not use.

    Parameters
    ----------
    fit : cameras and poses of the body, by :func:`fit_hand_held`.
    camera : index of the camera.
    sightings : sightings of the body, with p points each, that all move or are all stationary.

    Returns
    -------
    (n, p, 2) in px; NaN for a point that is not visible.
    """
    visible = np.isfinite(sightings.pixels)
    if not len(sightings):
        return np.zeros(visible.shape)
    kind = Kind.FREE if (sightings.point < 0).all() else Kind.STATIONARY
    paths = fit.problem.trajectories.free_paths
    number = sightings.point if kind is Kind.STATIONARY else path_at(paths, sightings.times_s)
    factors = make_sighting_factors(camera, sightings, number, kind, fit.observations.bodies, 0.0)
    units = np.broadcast_to(np.eye(visible[0].size), factors.whitening.shape)
    problem = fit.problem
    errors_px = replace(factors, whitening=units).residuals(fit.state, problem.layout, problem.trajectories)
    return np.where(visible, errors_px.reshape(visible.shape), np.nan)


def hold_out_halves(
    fit: JointFit, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Array]:
    """Return the reprojection errors (n, p, 2) of the moving sightings of each camera, in fits without them.

    Each fit leaves out half of the time of one camera. The path then comes from the other cameras, and the
    pose and the clock of the camera from its other half. Sightings count at which another camera sees the
    body at nearly the same time: nothing else predicts its pose.
    """
    observations, errors = fit.observations, []
    count = len(observations.cameras)
    paths = fit.problem.trajectories.free_paths
    step_s = float(paths.steps_s[0])
    for camera, own in enumerate(observations.sightings):
        moving = (own.point < 0) & covers(paths, own.times_s)
        half_s = float(np.median(own.times_s[moving])) if moving.any() else 0.0
        shared = _shares(observations, camera)
        parts = []
        for number, out in enumerate((moving & (own.times_s < half_s), moving & (own.times_s >= half_s))):
            kept = [*observations.sightings]
            kept[camera] = own.select(~out)
            # Half of the time may not link all cameras.
            with suppress(FitError):
                rest = fit_hand_held(replace(observations, sightings=tuple(kept)), fit.settings, step_s)
                parts.append(predict_errors(rest, camera, own.select(out & shared)))
            progress(2 * camera + number + 1, 2 * count)
        errors.append(np.concatenate([np.zeros((0, *own.pixels.shape[1:])), *parts]))
    return errors


def _shares(observations: Observations, camera: int) -> NDArray[np.bool_]:
    """Return a mask of the sightings of a camera near which another camera sees the body."""
    others = [own for number, own in enumerate(observations.sightings) if number != camera]
    known_s = np.sort(np.concatenate([own.times_s[own.point < 0] for own in others]))
    times_s = observations.sightings[camera].times_s
    if not len(known_s):
        return np.zeros(len(times_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(known_s, times_s), 1, max(len(known_s) - 1, 1))
    near_s = np.minimum(
        *(np.abs(times_s - known_s[np.minimum(n, len(known_s) - 1)]) for n in (after, after - 1))
    )
    return np.asarray(near_s < SAME_TIME_S)


def corner_sigma(fit: JointFit) -> float:
    """Return the standard deviation of a corner in px: errors within images, beside any pose of the body."""
    squares, freedom = 0.0, 0
    problem = fit.problem
    for weighted in problem.sightings:
        visible = np.repeat(np.isfinite(weighted.sightings.pixels[:, :, 0]), 2, axis=1)
        factors = replace(weighted, whitening=np.eye(visible.shape[1]) * visible[:, :, None])
        place = factors.place(fit.state, problem.layout, problem.trajectories)
        by_pose = factors.slopes(place, fit.state, problem.layout).by_pose * visible[:, :, None]
        errors_px = factors.residuals(fit.state, problem.layout, problem.trajectories)
        axes, _ = np.linalg.qr(by_pose)
        rest = errors_px - (axes @ (axes.swapaxes(1, 2) @ errors_px[:, :, None]))[:, :, 0]
        squares += float((rest**2).sum())
        freedom += int(visible.sum()) - 6 * len(visible)
    return float(np.sqrt(squares / max(freedom, 1)))


def misfits(fit: JointFit) -> dict[str, float]:
    """Return the errors of each part of the moving body, such as a marker, in units of its noise.

    They are 1 for a part that fits. The robust loss hides a wrong part: some of its sightings are outliers,
    and the others agree. So the tenth of the sightings with the largest errors decides.
    """
    parts: dict[str, list[Array]] = {}
    for factors in fit.problem.sightings:
        if factors.kind is Kind.FREE:
            visible = np.isfinite(factors.sightings.pixels[:, :, 0]).sum(axis=1)
            chi2 = factors.chi2(fit.state, fit.problem.layout, fit.problem.trajectories) / (2 * visible)
            for body in np.unique(factors.sightings.body).tolist():
                own = chi2[factors.sightings.body == body]
                parts.setdefault(fit.observations.bodies[body].name, []).append(own)
    return {
        name: float(np.sqrt(np.percentile(np.concatenate(own), 90) / _USUAL_CHI2))
        for name, own in parts.items()
    }


def distance_errors(fit: JointFit) -> Array:
    """Return errors (n,) of the distances of neighbouring points of a board, which pairs of cameras measure.

    Each half of the time is measured with cameras from the other half. The path of the board in this half
    only brings the points of two frames to one instant: their places come from the two cameras.

    Returns
    -------
    Differences from the distances on the board, in m.
    """
    times_s = np.concatenate([own.times_s[own.point < 0] for own in fit.observations.sightings])
    half_s, errors = float(np.median(times_s)), []
    for late in (False, True):
        inside = [(own.times_s >= half_s) == late for own in fit.observations.sightings]
        parts = zip(fit.observations.sightings, inside, strict=True)
        kept, out = zip(*((own.select(~mask), own.select(mask)) for own, mask in parts), strict=True)
        step_s = float(fit.problem.trajectories.free_paths.steps_s[0])
        with suppress(FitError):
            cameras = fit_hand_held(replace(fit.observations, sightings=kept), fit.settings, step_s)
            path = fit_path(cameras, replace(fit.observations, sightings=out), step_s)
            errors += list(_distance_errors(path))
    return np.concatenate(errors) if errors else np.zeros(0)


def _distance_errors(path: JointFit) -> Iterator[Array]:
    """Yield the errors of the distances that two cameras measure at one instant."""
    models = list(build_models(path).values())
    points_m = path.observations.bodies[0].points_m
    apart_m = np.linalg.norm(points_m[:, None] - points_m, axis=2)
    pairs = np.argwhere(np.triu(np.isclose(apart_m, np.min(apart_m[apart_m > 0]))))
    for first in range(len(models)):
        for second in range(first + 1, len(models)):
            for rows in _simultaneous(path, first, second):
                seen = [_at_instant(path, n, rows) for n in (first, second)]
                good = np.isfinite(seen[0][:, 0]) & np.isfinite(seen[1][:, 0])
                if good.sum() < 2:
                    continue
                places_m = np.full((len(points_m), 3), np.nan)
                places_m[good] = _triangulate([models[first], models[second]], [one[good] for one in seen])
                measured_m = np.linalg.norm(np.subtract(*places_m[pairs.T]), axis=1)
                misses_m = measured_m - apart_m[tuple(pairs.T)]
                yield misses_m[np.isfinite(misses_m)]


def _simultaneous(path: JointFit, first: int, second: int) -> Iterator[tuple[float, dict[int, int]]]:
    """Yield instants, with the rows of two cameras near them."""
    own, other = (_times_s(path, n) for n in (first, second))
    for row, time_s in enumerate(own.tolist()):
        if len(other):
            near = int(np.abs(other - time_s).argmin())
            if abs(other[near] - time_s) < SAME_TIME_S:
                yield time_s, {first: row, second: near}


def _times_s(path: JointFit, camera: int) -> Array:
    """Return the times of the sightings of a camera by the common clock."""
    block = path.problem.layout.cameras[camera]
    clock_s = float(path.state.values[block.edge + 1])
    return path.observations.sightings[camera].times_s + clock_s


def _at_instant(path: JointFit, camera: int, instant: tuple[float, dict[int, int]]) -> Array:
    """Return the points (p, 2) in px that a camera would see at an instant, with its errors."""
    time_s, rows = instant
    own = path.observations.sightings[camera].select(np.array([rows[camera]]))
    errors_px = predict_errors(path, camera, own)[0]
    times_s = np.array([time_s])
    pose = path.problem.trajectories.place_free(
        path_at(path.problem.trajectories.free_paths, times_s), times_s, path.state
    )
    block = path.problem.layout.cameras[camera]
    points_m = path.observations.bodies[0].points_m @ pose.turns[0].T + pose.positions_m[0]
    origin_m = path.state.values[block.start + 3 : block.start + 6]
    points_c = (points_m - origin_m) @ path.state.camera_turns[camera].T
    return np.asarray(project_points(block.model, path.state.values[block.lens], points_c) - errors_px)


def _triangulate(models: list[JointModel], pixels: list[Array]) -> Array:
    """Return points (n, 3) from their places in two images."""
    first, second = (
        np.column_stack([model.camera_from_world, -model.camera_from_world @ model.origin_m])
        for model in models
    )
    uv = [undistort(own, model.calibration).T for own, model in zip(pixels, models, strict=True)]
    points = np.asarray(cv2.triangulatePoints(first, second, *uv), dtype=np.float64)
    return np.asarray((points[:3] / points[3]).T)
