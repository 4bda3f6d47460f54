"""The cameras of a joint calibration: poses, fields of view, corner residuals, clocks beside node clocks.

The times of a node's frames are converted by its clock estimates, so the joint calibration should find no
clock offset. An offset beyond the bound of the estimates and its own uncertainty has one of two causes:
delays of the network that differ between both directions, or a latency of the camera that the rig does not
give.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import restore_joint
from ipsys_log.messages import Array, ClockEstimate, Model
from ipsys_log.statistics.floor_cameras import outline_view
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import PosedCamera

Size = tuple[int, int]

# An image has so many cells along its width; smaller cells would hold too few corners.
_CELLS = 16
# A cell with fewer corners has no reliable mean.
_LEAST_CORNERS = 3
# A clock that the fit keeps constant has a smaller standard deviation, by rounding.
_NO_SIGMA_S = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class ImageResiduals:
    """Mean corner residuals in the cells of an image.

    A residual is estimated minus measured. The estimate is that of the fit: it uses one place of a marker for
    all cameras, and one path of a robot.

    Attributes
    ----------
    cells_px : (c, 2), mean position of the corners in each cell with enough corners.
    means_px, rms_px : (c, 2) and (c,), mean residual, and root mean square per coordinate, of each cell.
    total_rms_px : root mean square per coordinate of all corners.
    corners : number of corners.
    outliers : number of sightings that do not fit; they are left out.
    """

    cells_px: Array
    means_px: Array
    rms_px: Array
    total_rms_px: float
    corners: int
    outliers: int


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """A camera of a joint calibration.

    Attributes
    ----------
    camera : its name; ``size_px`` are width and height of its images, None if they are unknown.
    origin_m, sigmas_m : (3,), its position in the world, and the standard deviations.
    axis : (3,), direction of its optical axis in the world.
    outline_m : (k, 2), outline of its field of view on the floor; empty without a size.
    clock_s, clock_sigma_s : time to add to its stamps. The sigma is 0 for the reference clock and without a
        drive.
    residuals : None for a model of another log.
    """

    camera: str
    size_px: Size | None
    origin_m: Array
    sigmas_m: Array
    axis: Array
    outline_m: Array
    clock_s: float
    clock_sigma_s: float
    residuals: ImageResiduals | None


def describe_cameras(
    model: Model, sizes_px: Mapping[str, Size], fit: JointFit | None
) -> tuple[CalibratedCamera, ...]:
    """Return the cameras of a joint model.

    Parameters
    ----------
    model : the fitted model.
    sizes_px : width and height of the images by camera.
    fit : the fit of the model, for the residuals; None for a model of another log.
    """
    names = [] if fit is None else [camera.name for camera in fit.observations.cameras]
    cameras = []
    for name, joint in restore_joint(model).items():
        size_px = sizes_px.get(name)
        residuals = None
        if fit is not None and size_px is not None and name in names:
            residuals = _residuals(fit, names.index(name), size_px)
        cameras.append(_describe(name, joint, size_px, residuals))
    return tuple(cameras)


def _describe(
    name: str, model: JointModel, size_px: Size | None, residuals: ImageResiduals | None
) -> CalibratedCamera:
    variances = (model.modes**2).sum(axis=1)
    clock_sigma_s = float(np.sqrt(variances[6 + len(model.lens) + 1]))
    outline_m = np.zeros((0, 2))
    if size_px is not None:
        lens = replace(model.calibration, width=size_px[0], height=size_px[1])
        outline_m = outline_view(PosedCamera(name, lens, model.camera_from_world, model.origin_m))
    return CalibratedCamera(
        name,
        size_px,
        model.origin_m,
        np.sqrt(variances[3:6]),
        model.camera_from_world[2],
        outline_m,
        model.clock_s,
        clock_sigma_s if clock_sigma_s > _NO_SIGMA_S else 0.0,
        residuals,
    )


def _residuals(fit: JointFit, number: int, size_px: Size) -> ImageResiduals | None:
    """Return the residuals of a camera by its number in a fit; None if nothing fits."""
    misses_px, corners_px, outliers = [np.zeros((0, 2))], [np.zeros((0, 2))], 0
    for factors in fit.problem.sightings:
        if factors.camera != number:
            continue
        whitened = factors.residuals(fit.state, fit.problem.layout, fit.problem.trajectories)
        residuals_px = np.linalg.solve(factors.whitening, whitened[:, :, None])[:, :, 0]
        good = (whitened**2).sum(axis=1) <= factors.limit
        misses_px.append(residuals_px[good].reshape(-1, 2))
        corners_px.append(factors.sightings.pixels[good].reshape(-1, 2))
        outliers += int((~good).sum())
    misses, corners = np.concatenate(misses_px), np.concatenate(corners_px)
    if not len(misses):
        return None
    total_px = float(np.sqrt((misses**2).mean()))
    cells = _average(corners, misses, size_px[0] / _CELLS)
    return ImageResiduals(*cells, total_px, len(misses), outliers)


def _average(corners_px: Array, misses_px: Array, cell_px: float) -> tuple[Array, Array, Array]:
    """Return mean position (c, 2), mean (c, 2) and root mean square (c,) of the residuals in each cell."""
    cells, index = np.unique(np.floor(corners_px / cell_px), axis=0, return_inverse=True)
    index = index.reshape(-1)
    counts = np.bincount(index, minlength=len(cells))

    def mean(values: Array) -> Array:
        sums = [np.bincount(index, column, len(cells)) for column in values.T]
        return np.asarray(np.stack(sums, axis=1) / counts[:, None])

    kept = counts >= _LEAST_CORNERS
    rms_px = np.sqrt(mean(misses_px**2).mean(axis=1))
    return mean(corners_px)[kept], mean(misses_px)[kept], rms_px[kept]


_SIGMAS = 3.0
_MS_PER_S = 1000.0


@dataclass(frozen=True, slots=True)
class ClockContradiction:
    """A camera of a node whose two clock estimates contradict each other.

    Attributes
    ----------
    camera : its name.
    difference_s : time that the joint calibration adds to its stamps; the node's estimate leaves 0.
    sigma_s : standard deviation of the joint calibration.
    bound_s : mean bound of the node's estimates, plus that of the reference camera if it has a node too.
    """

    camera: str
    difference_s: float
    sigma_s: float
    bound_s: float

    @property
    def text(self) -> str:
        """The contradiction in one sentence."""
        difference_ms, sigma_ms, bound_ms = (
            value * _MS_PER_S for value in (self.difference_s, self.sigma_s, self.bound_s)
        )
        return (
            f"camera {self.camera}: the joint calibration corrects its clock by {difference_ms:+.1f} ms "
            f"(standard deviation {sigma_ms:.1f} ms), but its node states an error below {bound_ms:.1f} ms"
        )


def find_contradicted_clocks(model: Model, estimates: Iterable[ClockEstimate]) -> list[ClockContradiction]:
    """Compare the clocks of a joint model with the estimates of the nodes in the log of its fit.

    Parameters
    ----------
    model : the joint model of this log.
    estimates : all clock estimates of the log.
    """
    bounds_ns: dict[str, list[int]] = {}
    for estimate in estimates:
        bounds_ns.setdefault(estimate.camera, []).append(estimate.bound_ns)
    bounds_s = {camera: float(np.mean(rows)) / NS_PER_S for camera, rows in bounds_ns.items()}
    if not bounds_s:
        return []
    cameras = describe_cameras(model, {}, None)
    reference_s = max(
        (bounds_s.get(camera.camera, 0.0) for camera in cameras if camera.clock_sigma_s == 0), default=0.0
    )
    rows = [
        _compare(camera, bounds_s[camera.camera] + reference_s)
        for camera in cameras
        if camera.camera in bounds_s
    ]
    return [row for row in rows if abs(row.difference_s) > row.bound_s + _SIGMAS * row.sigma_s]


def _compare(camera: CalibratedCamera, bound_s: float) -> ClockContradiction:
    return ClockContradiction(camera.camera, camera.clock_s, camera.clock_sigma_s, bound_s)
