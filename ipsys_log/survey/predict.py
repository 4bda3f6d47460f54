"""Where the present model has a marker, beside where the tape has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Model
from ipsys_log.models.applied import AppliedModel

__all__ = ["Prediction", "predict"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the model of a camera has the marker, ``world_m`` (3,), and ``off_m`` how far from the tape.

    ``sigma_m`` is the model's own in the worst direction, ``inside`` whether the place lies among those
    that it was fitted to; None where the model does not say.
    """

    camera: str
    world_m: Array
    off_m: float
    sigma_m: float | None
    inside: bool | None


def predict(model: Model, points_m: Mapping[str, Array], world_m: Array) -> tuple[Prediction, ...]:
    """What the model of each camera that saw the marker says.

    Parameters
    ----------
    model : out of a log.
    points_m : mean camera point (3,) by camera.
    world_m : (3,), by tape and ruler; models that need the height of the marker get it from here.
    """
    applied = _applied(model)
    heights_m = np.array([world_m[2]])
    found = []
    for camera, point_m in sorted(points_m.items()):
        if camera not in applied:
            continue
        one, here_m = applied[camera], point_m[None]
        there_m = one.predict(here_m, heights_m)
        if not np.isfinite(there_m).all():
            continue
        covariances_m2 = one.covariances(here_m, heights_m)
        sigma_m = None
        if covariances_m2 is not None:
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariances_m2[0])[-1]))
        sigmas_m = np.zeros(1) if covariances_m2 is None else np.sqrt(covariances_m2[:, 2, 2])
        inside = one.inside(here_m, there_m, sigmas_m)
        off_m = float(np.linalg.norm(there_m[0] - world_m))
        found.append(
            Prediction(camera, there_m[0], off_m, sigma_m, None if inside is None else bool(inside[0]))
        )
    return tuple(found)


@lru_cache(maxsize=2)
def _applied(model: Model) -> dict[str, AppliedModel]:
    return {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}
