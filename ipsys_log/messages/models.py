"""Payloads of the calibration of a lab: tape measurements, fitted models, and their evaluation."""

from dataclasses import dataclass

from ipsys_log.messages.message import Floats, Mat33, Mat66, TimeNs, Vec3


@dataclass(frozen=True, slots=True)
class Distance:
    reference: str
    distance_m: float
    sigma_m: float | None = None


@dataclass(frozen=True, slots=True)
class Interval:
    start: TimeNs
    end: TimeNs


@dataclass(frozen=True, slots=True)
class WorldPoint:
    x_m: float
    y_m: float
    z_m: float


@dataclass(frozen=True, slots=True)
class Measurement:
    """A tape measurement of one marker at one calibration point; or a baseline, a withdrawal, a re-admission.

    A message with ``from_reference`` is a baseline: distances from this reference point to others, read with
    the same tape. A message with ``withdraws`` or ``readmits`` has the id of a measurement there, and perhaps
    a reason. The last message about a measurement counts.
    """

    timestamp: TimeNs
    id: str
    withdraws: str | None = None
    marker_id: int | None = None
    distances: tuple[Distance, ...] = ()
    side: str | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None
    still: Interval | None = None
    point: WorldPoint | None = None
    splits: tuple[str, ...] = ()
    calibration_point: str | None = None
    readmits: str | None = None
    reason: str | None = None
    from_reference: str | None = None

    @property
    def is_point(self) -> bool:
        """Return whether the message is a measurement of a marker, and nothing else."""
        return self.refers_to is None and self.from_reference is None

    @property
    def refers_to(self) -> str | None:
        """The id of the measurement that this message withdraws or re-admits; None for a measurement."""
        return self.withdraws if self.withdraws is not None else self.readmits


@dataclass(frozen=True, slots=True, eq=False)
class Parameter:
    """A named array of a model: ``values`` in C order of ``shape``."""

    name: str
    shape: tuple[int, ...]
    values: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A calibration point: mean camera point of the stationary marker, and its world point.

    ``calibration_point`` is the name of the point if it is not the id of the measurement.
    """

    measurement: str
    marker_id: int
    camera_m: Vec3
    world_m: Vec3
    frames: int
    world_covariance_m2: Mat33 | None = None
    calibration_point: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """The terms of the covariance of a position, see :mod:`ipsys_log.models.uncertainty`.

    ``along`` is the relative error of a depth, ``across`` that of (u, v), ``growth`` the power of their
    growth. ``fit`` is the covariance of (u, v, ln Zc) that has the same effect as the uncertainty of the fit.
    """

    along: float
    across: float
    growth: float
    fit: Mat33


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    camera: str
    parameters: tuple[Parameter, ...]
    covariance_m2: Mat33 | None = None
    pairs: tuple[Pair, ...] = ()
    noise: Noise | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A fitted model. The parameters ``shared`` belong to each camera that has none of the same name."""

    timestamp: TimeNs
    name: str
    cameras: tuple[CameraModel, ...]
    shared: tuple[Parameter, ...] = ()


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of a set of distances.

    ``std_m`` divides by count - 1, as in Tables I and II. ``mean_low_m`` and ``mean_high_m`` are the 95 %
    confidence interval of the mean. ``remaining_m`` is the mean without the stated error of the tape, with
    its interval; None against the ground truth, or if the tape has no sigma.
    """

    count: int
    mean_m: float
    min_m: float
    max_m: float
    std_m: float | None = None
    median_m: float | None = None
    p95_m: float | None = None
    mean_low_m: float | None = None
    mean_high_m: float | None = None
    remaining_m: float | None = None
    remaining_low_m: float | None = None
    remaining_high_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    measurement: str
    world_m: Vec3
    predicted_m: Vec3


@dataclass(frozen=True, slots=True, eq=False)
class CameraEvaluation:
    """Errors of a camera (``""``: of all) against the ``tape`` or, in a simulated lab, the ground ``truth``.

    ``scheme`` is ``held_out`` (also if it is absent) or ``cross_validation``. Cross-validation has a residual
    for each calibration point and repeat, repeat by repeat. ``within_68`` and ``within_95`` are the shares of
    the residuals within these regions of their covariance.
    """

    camera: str
    against: str
    error_3d: ErrorStatistics | None
    error_2d: ErrorStatistics
    residuals: tuple[Residual, ...] = ()
    scheme: str | None = None
    bias_m: Vec3 | None = None
    within_68: float | None = None
    within_95: float | None = None


@dataclass(frozen=True, slots=True)
class LearningPoint:
    """Mean errors of models fitted on ``pairs`` calibration points: a subset ``label``, or random subsets."""

    camera: str
    pairs: int
    mean_3d_m: float
    mean_2d_m: float
    subsets: int
    label: str | None = None
    std_3d_m: float | None = None
    std_2d_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Suspect:
    """A measurement that disagrees with the model fitted without it, and a possible explanation.

    ``residual_m`` is predicted minus measured, the mean over ``cameras``. ``score`` is its length in units of
    the usual length. ``kind`` is one of ``side``, ``swapped``, ``distance``, ``height``, or None.
    """

    measurement: str
    cameras: tuple[str, ...]
    residual_m: Vec3
    score: float
    kind: str | None = None
    text: str | None = None
    corrected_m: Vec3 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The errors of a model, and the measurements that contradict it.

    ``cameras`` and ``learning`` are without the gross outliers ``excluded``. ``with_excluded`` are the errors
    with them; it is empty if there are none.
    """

    timestamp: TimeNs
    model: str
    cameras: tuple[CameraEvaluation, ...]
    learning: tuple[LearningPoint, ...] = ()
    suspects: tuple[Suspect, ...] = ()
    excluded: tuple[Suspect, ...] = ()
    with_excluded: tuple[CameraEvaluation, ...] = ()


# The states of a camera that has moved.
MOVED, SUSPECTED, CLEARED = "moved", "suspected", "cleared"
REPAIRED, PARTLY = "repaired", "partly"


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """The pose of a camera that has moved since the calibration.

    ``state`` is ``moved``: positions keep the old pose, with a larger covariance; ``suspected``: this camera
    or another one has moved; ``cleared``: it was another one; ``repaired``: positions use this pose; or
    ``partly``: they use it, but only a part of the motion is known. ``since`` is the time of the motion.
    ``covariance`` is that of a turn about the axes of the camera (rad) and a shift in the world (m), from
    ``deviations`` mean deviations of markers.
    """

    camera: str
    state: str
    since: TimeNs
    position_m: Vec3
    camera_from_world: Mat33
    covariance: Mat66
    deviations: int


@dataclass(frozen=True, slots=True, eq=False)
class CameraPoses:
    """The poses of cameras that have moved, as they are known at ``timestamp``; others keep theirs."""

    timestamp: TimeNs
    poses: tuple[CameraPose, ...]
