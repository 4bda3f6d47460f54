"""Camera points to world positions, through the model of each camera."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ipsys_log.messages import CameraModel, CameraPoint, CameraPoints, Message, Model, Position, Positions
from ipsys_log.models import restore

__all__ = ["READS", "Locate"]

READS = (CameraPoints,)

# Far enough for the digits, near enough for the curvature of a model.
_STEP_M = 0.01


class Locate:
    """The stage *locate*. A camera that the model does not know has no positions."""

    def __init__(self, model: Model) -> None:
        self._cameras = {camera.camera: _Applied(model.name, camera) for camera in model.cameras}

    def __call__(self, message: Message) -> Iterator[Any]:
        applied = self._cameras.get(str(message.camera))
        if applied is not None:
            points = message.payload.points
            yield Positions(message.publish_time_ns, applied.positions(points) if points else ())


class _Applied:
    """The model of one camera, restored from its parameters."""

    def __init__(self, name: str, camera: CameraModel) -> None:
        arrays = {p.name: p.values.reshape(p.shape) for p in camera.parameters}
        self._estimator = restore(name, arrays)
        self._covariance_m2 = camera.covariance_m2

    def positions(self, points: tuple[CameraPoint, ...]) -> tuple[Position, ...]:
        here = np.array([(p.x_m, p.y_m, p.z_m) for p in points])
        # The marker's direction is carried over by mapping a second point a little along it.
        angles = np.array([-p.heading_rad if p.heading_rad is not None else 0.0 for p in points])
        ahead = here + _STEP_M * np.stack([np.cos(angles), np.sin(angles), np.zeros(len(points))], axis=1)
        world, world_ahead = np.split(self._estimator.predict(np.vstack([here, ahead])), 2)
        along = world_ahead - world
        headings = np.arctan2(along[:, 1], along[:, 0])
        return tuple(
            Position(
                point.id, x_m, y_m, z_m, None if point.heading_rad is None else angle, self._covariance_m2
            )
            for point, (x_m, y_m, z_m), angle in zip(points, world.tolist(), headings.tolist(), strict=True)
        )
