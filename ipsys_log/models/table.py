"""Table of models, their parameters as named arrays, and models applied to points.

A log stores a fitted model as named arrays (:func:`parameters`, :func:`restore`), not as a pickle.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import Array, CameraModel
from ipsys_log.models.plain_models import Polynomial, Rigid
from ipsys_log.models.rays import CalibrationPoints, group_cameras
from ipsys_log.models.uncertainty import Uncertainty, Volume


def _rigid() -> Any:
    from ipsys_log.models.closed_form import RigidTransform

    return RigidTransform()


def _poly() -> Any:
    from ipsys_log.models.closed_form import PolynomialRegression

    return PolynomialRegression()


def _ann() -> Any:
    from ipsys_log.models.ann import NeuralNetwork

    return NeuralNetwork()


def _kriging(noisy: bool = False) -> Any:
    from ipsys_log.models.kriging import Kriging

    return Kriging(noisy=noisy)


def _ray_plane() -> Any:
    from ipsys_log.models.ray_models import RayPlane

    return RayPlane()


def _ray_depth() -> Any:
    from ipsys_log.models.ray_models import RayDepth

    return RayDepth()


@dataclass(frozen=True, slots=True)
class ModelPart:
    """A model, or one of the two parts of a hybrid model.

    Attributes
    ----------
    create : returns an unfitted estimator; None for a model of corners. It imports the model late:
        scikit-learn takes 1.5 s, and most commands use no model.
    version : version of the model; it rises by one with each change of the fitted parameters.
    min_pairs : least number of calibration points.
    reads_height : True if the model needs the height of a marker above the floor.
    """

    create: Callable[[], Any] | None
    version: int
    min_pairs: int
    reads_height: bool = False


MODEL_PARTS = {
    "rigid": ModelPart(_rigid, version=1, min_pairs=3),
    "poly": ModelPart(_poly, version=1, min_pairs=10),
    "ann": ModelPart(_ann, version=2, min_pairs=10),
    "kriging": ModelPart(_kriging, version=2, min_pairs=6),
    "kriging-regression": ModelPart(lambda: _kriging(noisy=True), version=2, min_pairs=6),
    "rayplane": ModelPart(_ray_plane, version=3, min_pairs=5, reads_height=True),
    "best": ModelPart(_ray_depth, version=2, min_pairs=5),
    "joint": ModelPart(None, version=7, min_pairs=0, reads_height=True),
}

# First the models of the paper in the order of its tables: RT, PR, RT+PR, ANN, RT+ANN, KI, RT+KI, KR, RT+KR.
# In a hybrid, the output of the first model is the input of the second.
MODELS = (
    "rigid",
    "poly",
    "rigid+poly",
    "ann",
    "rigid+ann",
    "kriging",
    "rigid+kriging",
    "kriging-regression",
    "rigid+kriging-regression",
    "rayplane",
    "best",
)

# Models that are fitted and applied without scikit-learn: its import takes longer than a hundred fits.
_PLAIN = {"rigid": Rigid, "poly": Polynomial}

# Models of the corners of markers. The fit estimates all cameras together, see ipsys_log.calibration.joint.
CORNER_MODELS = ("joint",)


def is_known(name: str) -> bool:
    """Return whether this version has a model."""
    return name in MODELS or reads_corners(name)


def check_name(name: str) -> None:
    """Check that a model is known."""
    if not is_known(name):
        known = ", ".join(MODELS + CORNER_MODELS)
        raise IpsysError(f"model {name!r} is not known; use one of {known}")


def reads_corners(name: str) -> bool:
    """Return whether a model reads the corners of markers, and not their camera points."""
    return name in CORNER_MODELS


def model_run(name: str) -> str:
    """Return the name of the run of a model, unless it is taken."""
    return name.replace("+", "_").replace("-", "_")


def create(name: str) -> Any:
    """Return an unfitted estimator by its name in :data:`MODELS`."""
    check_name(name)
    if reads_corners(name):
        raise IpsysError(
            f"model {name} is fitted to the corners of markers, and cannot be used with camera points; use "
            "another model such as best"
        )
    steps = [(part, _create_part(part)) for part in name.split("+")]
    if len(steps) == 1:
        return steps[0][1]
    from sklearn.pipeline import Pipeline

    return Pipeline(steps)


def _new(name: str) -> Any:
    return _PLAIN[name]() if name in _PLAIN else create(name)


def _create_part(name: str) -> Any:
    create_estimator = MODEL_PARTS[name].create
    assert create_estimator is not None, name
    return create_estimator()


def min_pairs(name: str) -> int:
    """Return the least number of calibration points that a model needs."""
    check_name(name)
    return max(MODEL_PARTS[part].min_pairs for part in name.split("+"))


def reads_height(name: str) -> bool:
    """Return whether a model needs the height of a marker above the floor."""
    check_name(name)
    return any(MODEL_PARTS[part].reads_height for part in name.split("+"))


def needs_height(name: str) -> bool:
    """Return whether a model gives no position to a marker whose height is unknown."""
    return reads_height(name) and not reads_corners(name)


def inputs(name: str, points_m: NDArray[np.float64], heights_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inputs of a model: camera points (n, 3), and heights (n,) if the model needs them."""
    return np.concatenate([points_m, heights_m[:, None]], axis=1) if reads_height(name) else points_m


def predict_array(estimator: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``estimator.predict(points)`` for an array (n, d) of numbers, without scikit-learn's checks.

    For the few points of a frame, these checks take ten times as long as a model. An estimator without its
    own ``predict_array`` still does the checks.
    """
    for _, step in _steps(estimator):
        points = (step.predict_array if hasattr(step, "predict_array") else step.predict)(points)
    return points


def fit_cameras(name: str, cameras: Mapping[str, CalibrationPoints]) -> dict[str, Any]:
    """Fit a model for each camera to the calibration points that it measured, for :func:`predict_array`.

    The fit of physical models uses all cameras at once: points that two cameras measured tie them together.

    Raises
    ------
    FitError
        The calibration points do not determine a model. The text names the camera.
    """
    models = {camera: _new(name) for camera in cameras}
    if (fit_jointly := getattr(_new(name), "fit_jointly", None)) is not None:
        return dict(zip(models, fit_jointly([*models.values()], [*cameras.values()]), strict=True))
    for camera, places in cameras.items():
        try:
            fit = models[camera].fit_array if name in _PLAIN else models[camera].fit
            fit(inputs(name, places.points_m, places.world_m[:, 2]), places.world_m)
        except FitError as error:
            raise FitError(f"camera {camera}: {error}") from error
    return models


def group_dependent_cameras(name: str, cameras: Mapping[str, CalibrationPoints]) -> list[list[str]]:
    """Return groups of cameras whose models depend on common calibration points."""
    names = list(cameras)
    if not hasattr(_new(name), "fit_jointly"):
        return [[camera] for camera in names]
    return [[names[i] for i in group] for group in group_cameras(list(cameras.values()))]


def parameters(estimator: Any) -> dict[str, NDArray[np.float64]]:
    """Return the fitted parameters of an estimator, by names such as ``rigid.rotation``.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> model = create("rigid").fit(points, points + 1)
    >>> sorted(parameters(model))
    ['rotation', 'translation']
    >>> predict_array(restore("rigid", parameters(model)), points[:1]).round(9).tolist()
    [[1.0, 1.0, 1.0]]
    """
    return {
        prefix + attribute.rstrip("_"): np.asarray(getattr(step, attribute), dtype=np.float64)
        for prefix, step in _steps(estimator)
        for attribute in step.fitted
    }


def restore(name: str, arrays: Mapping[str, NDArray[np.float64]]) -> Any:
    """Return the model ``name`` with parameters from :func:`parameters`, for :func:`predict_array`."""
    estimator = _new(name)
    for part, (prefix, step) in zip(name.split("+"), _steps(estimator), strict=True):
        step.n_features_in_ = 4 if MODEL_PARTS[part].reads_height else 3
        for attribute in step.fitted:
            key = prefix + attribute.rstrip("_")
            if key not in arrays:
                raise IpsysError(f"the stored model {name} has no parameter {key!r}; fit it again")
            setattr(step, attribute, np.array(arrays[key], dtype=np.float64))
    return estimator


def _steps(estimator: Any) -> list[tuple[str, Any]]:
    steps = getattr(estimator, "steps", None)  # of a scikit-learn Pipeline
    return [("", estimator)] if steps is None else [(f"{name}.", step) for name, step in steps]


class AppliedModel:
    """The model of one camera, restored from its parameters."""

    def __init__(self, name: str, camera: CameraModel) -> None:
        self._name = name
        self._estimator = restore(name, {p.name: p.values.reshape(p.shape) for p in camera.parameters})
        self._covariance_m2, self._uncertainty, self._volume = camera.covariance_m2, None, None
        self._height_check = None
        if not camera.pairs:
            return
        fitted_m = np.array([pair.camera_m for pair in camera.pairs])
        world_m = np.array([pair.world_m for pair in camera.pairs])
        self._volume = Volume(fitted_m, world_m)
        if reads_height(name):
            from ipsys_log.models.ray_models import HeightCheck

            self._height_check = HeightCheck(self._estimator.camera_rays, fitted_m, world_m)
        if camera.noise is not None:
            noise = camera.noise
            self._uncertainty = Uncertainty(noise.along, noise.across, noise.growth, noise.fit, fitted_m)

    def predict(self, points_m: Array, heights_m: Array) -> Array:
        """Return world points (n, 3) from camera points (n, 3) and heights (n,), all in m."""
        return predict_array(self._estimator, inputs(self._name, points_m, heights_m))

    def covariances(
        self, points_m: Array, heights_m: Array, height_sigmas_m: Array | None = None
    ) -> Array | None:
        """Return covariances (n, 3, 3) of the world points in m^2; None if they are unknown.

        ``height_sigmas_m`` (n,) are the standard deviations of the heights, for models that read heights;
        None for the usual one of a marker on a robot.
        """
        if self._uncertainty is not None:
            return self._uncertainty.covariances(self.predict, points_m, heights_m, height_sigmas_m)
        if self._covariance_m2 is not None:
            return np.broadcast_to(self._covariance_m2, (len(points_m), 3, 3))
        return None

    def error_modes(
        self, points_m: Array, heights_m: Array, height_sigmas_m: Array | None = None
    ) -> tuple[Array, Array] | None:
        """Return the errors of the model as modes (n, 3, k), and the other part (n, 3, 3) of the covariances.

        The last mode is the error of the height; see :meth:`Uncertainty.error_modes`. A model with a constant
        covariance has the same error everywhere. Return None if the covariances are unknown.
        """
        if self._uncertainty is not None:
            return self._uncertainty.error_modes(self.predict, points_m, heights_m, height_sigmas_m)
        if self._covariance_m2 is not None:
            count = len(points_m)
            root = np.linalg.cholesky(self._covariance_m2)
            modes_m = np.zeros((count, 3, 4))
            modes_m[:, :, :3] = root
            return modes_m, np.zeros((count, 3, 3))
        return None

    def inside(self, points_m: Array, world_m: Array, sigmas_m: Array) -> NDArray[np.bool_] | None:
        """Return a mask (n,) of the positions in the volume of the calibration points, see :class:`Volume`.

        ``points_m`` and ``world_m`` are (n, 3). Return None if the model does not contain the calibration
        points of its fit.
        """
        return self._volume.contains(points_m, world_m[:, 2], sigmas_m) if self._volume else None

    def at_height(
        self, points_m: Array, world_m: Array, height_sigmas_m: Array, depth_sigmas_m: Array
    ) -> NDArray[np.bool_]:
        """Return a mask (n,) of the markers whose depths agree with the heights that the model read.

        All agree if the model reads no heights. See :class:`ipsys_log.models.ray_models.HeightCheck`.
        """
        if self._height_check is None:
            return np.ones(len(points_m), dtype=bool)
        return self._height_check.agrees(points_m, world_m, height_sigmas_m, depth_sigmas_m)

    def rises(self, points_m: Array, world_m: Array, depth_sigmas_m: Array) -> tuple[Array, Array]:
        """Return the heights by the depths minus the heights that the model read, and their sigmas, (n,).

        The model must read heights. See :meth:`ipsys_log.models.ray_models.HeightCheck.rises`.
        """
        assert self._height_check is not None
        return self._height_check.rises(points_m, world_m, depth_sigmas_m)
