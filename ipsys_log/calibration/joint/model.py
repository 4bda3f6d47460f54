"""The joint model of a camera: intrinsics, pose and floor with their joint covariance, as named arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.floor_field import FloorField
from ipsys_log.calibration.joint.observations import lens_model_of
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.messages import Array, CameraCalibration

# Modes of the joint covariance below this share of a prior variance are left out.
_LEAST_SHARE = 1e-10
# Clock offsets and row times of fewer standard deviations than this may be 0.
_SIGNIFICANT = 3.0
# The unknowns of a camera beside its intrinsics: turn, origin, edge offset, clock, row time and scale.
_BESIDE_LENS = 10


@dataclass(frozen=True, slots=True, eq=False)
class JointModel:
    """A calibrated camera above a floor.

    The errors of all cameras and of the floor are linear functions of the same m independent standard normal
    numbers. The covariance of any two cameras is therefore the product of their modes.

    Attributes
    ----------
    lens_model : ``kannala_brandt``, ``plumb_bob`` or ``rational_polynomial``, see ``lens``.
    camera_from_world : (3, 3), rotation.
    origin_m : (3,), position of the camera in the world.
    lens : (q,), intrinsics: fx, fy, cx, cy in px, and the coefficients of the distortion.
    edge_offset_px, clock_s, row_time_s : offset of edges; the time to add to the stamps of the camera; the
        time between rows. Both times are 0 if the estimate does not differ significantly from 0.
    scale : factor on the nominal size of a marker: the mean of all bodies.
    floor : the field of the floor, and ``amplitudes`` (f,) of its modes.
    modes : (6 + q + 3 + 1, m), by turn (3), origin (3), lens (q), edge offset, clock, row time, scale.
    floor_modes : (f, k), by the amplitudes of the floor, with k <= m. They do not depend on the other m - k
        numbers.
    corner_floor_px : repeatable part of the error of a corner.
    is_certain : False if another explanation of the tape readings places the cameras elsewhere.
    """

    lens_model: LensModel
    camera_from_world: Array
    origin_m: Array
    lens: Array
    edge_offset_px: float
    clock_s: float
    row_time_s: float
    scale: float
    floor: FloorField
    amplitudes: Array
    modes: Array
    floor_modes: Array
    corner_floor_px: float
    is_certain: bool = True

    @property
    def calibration(self) -> CameraCalibration:
        """The estimated intrinsics, without an image size."""
        fx, fy, cx, cy = self.lens[:4].tolist()
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return CameraCalibration(0, "", 0, 0, self.lens_model.distortion_model, self.lens[4:], K)

    def without_modes(self) -> JointModel:
        """Return the model without its covariance: positions do not depend on it, and take less time."""
        return replace(self, modes=self.modes[:, :0], floor_modes=self.floor_modes[:, :0])

    def error_modes(self, by_camera: Array, by_height: Array, floor_at: Array) -> Array:
        """Return the errors (n, r, m) of n results with r components by the modes.

        Parameters
        ----------
        by_camera : (n, r, 6 + q + 3 + 1), derivatives by the unknowns of the camera.
        by_height : (n, r, 1), derivatives by the height of the floor.
        floor_at : (n, f), this height by the amplitudes of the floor.
        """
        errors: Array = by_camera @ self.modes
        errors[:, :, : self.floor_modes.shape[1]] += by_height * (floor_at @ self.floor_modes)[:, None]
        return errors

    def to_arrays(self) -> dict[str, Array]:
        """Return the model as named arrays of floats."""
        return {
            "camera_from_world": self.camera_from_world,
            "origin_m": self.origin_m,
            "lens": self.lens,
            "offsets": np.array([self.edge_offset_px, self.clock_s, self.row_time_s, self.scale]),
            "corner_floor_px": np.array([self.corner_floor_px]),
            "floor_grid_m": np.array([*self.floor.origin_m, self.floor.spacing_m]),
            "floor_along_x": self.floor.along_x,
            "floor_along_y": self.floor.along_y,
            "floor_pairs": self.floor.pairs.astype(np.float64),
            "floor_amplitudes": self.amplitudes,
            "floor_modes": self.floor_modes,
            "modes": self.modes,
            **({} if self.is_certain else {"uncertain": np.ones(1)}),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array], lens: CameraCalibration) -> JointModel:
        """Return the model from its named arrays; ``lens`` names the lens model of the camera."""
        grid_m = arrays["floor_grid_m"]
        floor = FloorField(
            grid_m[:2],
            float(grid_m[2]),
            arrays["floor_along_x"],
            arrays["floor_along_y"],
            arrays["floor_pairs"].astype(np.intp).reshape(-1, 2),
        )
        edge_px, clock_s, row_s, scale = arrays["offsets"].tolist()
        # Logs of older versions have the rows of the floor after those of the camera.
        own, floor_modes = np.split(arrays["modes"], [len(arrays["lens"]) + _BESIDE_LENS])
        floor_modes = arrays.get("floor_modes", floor_modes)
        if len(own) != len(arrays["lens"]) + _BESIDE_LENS or len(floor_modes) != floor.count:
            raise ValueError(f"modes have {len(own)} and {len(floor_modes)} rows")
        return cls(
            lens_model_of(lens),
            arrays["camera_from_world"],
            arrays["origin_m"],
            arrays["lens"],
            edge_px,
            clock_s,
            row_s,
            scale,
            floor,
            arrays["floor_amplitudes"],
            own,
            floor_modes,
            float(arrays["corner_floor_px"][0]),
            "uncertain" not in arrays,
        )


def build_models(fit: JointFit) -> dict[str, JointModel]:
    """Return the model of each camera, by its name."""
    layout, state = fit.problem.layout, fit.state
    modes = _floor_first(covariance_modes(fit.covariance), layout.modes)
    # A copy: a view would keep the zeros beside it.
    floor_modes = modes[layout.modes, : layout.floor.count].copy()
    models = {}
    for number, (camera, block) in enumerate(zip(fit.observations.cameras, layout.cameras, strict=True)):
        if camera.is_former:
            continue
        edge_px = float(state.values[block.edge])
        clock_s, row_s = (_significant(fit, column) for column in range(block.edge + 1, block.stop))
        own = [modes[block.start : block.stop], modes[layout.scales].mean(axis=0)[None]]
        models[camera.name] = JointModel(
            block.model,
            state.camera_turns[number],
            state.values[block.start + 3 : block.start + 6],
            state.values[block.lens],
            edge_px,
            clock_s,
            row_s,
            float(state.values[layout.scales].mean()),
            layout.floor,
            state.values[layout.modes],
            np.concatenate(own),
            floor_modes,
            fit.settings.corner_floor_px,
            fit.is_certain,
        )
    return models


def _significant(fit: JointFit, column: int) -> float:
    """Return a global unknown, or 0 if it may be 0: synchronised cameras then have common instants."""
    value, sigma = float(fit.state.values[column]), float(np.sqrt(fit.covariance[column, column]))
    return value if abs(value) > _SIGNIFICANT * sigma else 0.0


def _floor_first(modes: Array, floor: slice) -> Array:
    """Return modes (g, m) of the same covariance, whose first numbers are those of the floor.

    An orthogonal map of the numbers keeps every product of modes. The f rows ``floor`` become a lower
    triangle in the first f columns, so that the floor of a hall is no larger than its own covariance.
    """
    axes, triangle = np.linalg.qr(modes[floor].T, mode="complete")
    turned: Array = modes @ axes
    turned[floor] = triangle.T
    return turned


def covariance_modes(covariance: Array) -> Array:
    """Return the modes (g, m) of a covariance (g, g): their product is the covariance."""
    sigma = np.sqrt(covariance.diagonal())
    units = np.where(sigma > 0, sigma, 1.0)
    variances, axes = np.linalg.eigh(covariance / units[:, None] / units)
    kept = variances > _LEAST_SHARE
    return np.asarray(units[:, None] * axes[:, kept] * np.sqrt(variances[kept]))
