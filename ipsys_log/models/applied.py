"""A model out of a log, ready to be applied."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import CameraModel
from ipsys_log.models.table import inputs, predict_array, restore
from ipsys_log.models.uncertainty import Uncertainty, Volume

__all__ = ["AppliedModel"]

Array = NDArray[np.float64]


class AppliedModel:
    """The model of one camera, restored from its parameters."""

    def __init__(self, name: str, camera: CameraModel) -> None:
        self._name = name
        self._estimator = restore(name, {p.name: p.values.reshape(p.shape) for p in camera.parameters})
        self._covariance_m2, self._uncertainty, self._volume = camera.covariance_m2, None, None
        if not camera.pairs:
            return
        fitted_m = np.array([pair.camera_m for pair in camera.pairs])
        self._volume = Volume(fitted_m, np.array([pair.world_m for pair in camera.pairs]))
        if camera.noise is not None:
            noise = camera.noise
            self._uncertainty = Uncertainty(noise.along, noise.across, noise.growth, noise.fit, fitted_m)

    def predict(self, points_m: Array, heights_m: Array) -> Array:
        """World points (n, 3) from camera points (n, 3) and heights (n,), all in m."""
        return predict_array(self._estimator, inputs(self._name, points_m, heights_m))

    def covariances(self, points_m: Array, heights_m: Array) -> Array | None:
        """Covariances (n, 3, 3) in m^2 of the world points; None where they are not known."""
        if self._uncertainty is not None:
            return self._uncertainty.covariances(self.predict, points_m, heights_m)
        if self._covariance_m2 is not None:
            return np.broadcast_to(self._covariance_m2, (len(points_m), 3, 3))
        return None

    def inside(self, points_m: Array, world_m: Array, sigmas_m: Array) -> NDArray[np.bool_] | None:
        """Whether positions (n, 3) lie in the volume of the measured places, see :class:`Volume`.

        None where the model does not say on which places it was fitted.
        """
        return self._volume.contains(points_m, world_m[:, 2], sigmas_m) if self._volume else None
