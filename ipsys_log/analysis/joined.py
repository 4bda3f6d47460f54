"""Cameras in one frame without a tape: by the plumb line of each, and markers that two of them see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.alignment import Alignment
from ipsys_log.analysis.coverage import Hung
from ipsys_log.analysis.still import Lying
from ipsys_log.geometry.poses import invert_pose, make_pose, transform
from ipsys_log.messages import CameraCalibration

__all__ = ["join_cameras"]

Array = NDArray[np.float64]

# Nearer together than that, places that two cameras see do not tell how these are turned.
_APART_M = 0.15
# What two cameras say of the same places differs by less; else these are not the same.
_ALIKE_M = 0.05


def join_cameras(alignments: Sequence[Alignment], lenses: Mapping[str, CameraCalibration]) -> list[Hung]:
    """The cameras that hang together with the first of them by markers that two see at the same time.

    The markers on the floor give the height and the plumb line of each camera; two places that both of two
    cameras see, how the one is turned and shifted against the other.

    Returns
    -------
    Places in a frame of which nothing is known but that its z = 0 is the floor; none for fewer than two.
    """
    known = {one.camera: one for one in alignments if one.axes == 2 and one.camera in lenses}
    waiting = list(known)
    joined = {waiting.pop(0): np.eye(4)} if waiting else {}
    while pairs := [(new, old, _turn(known[new], known[old])) for new in waiting for old in joined]:
        met = [(new, joined[old] @ turn) for new, old, turn in pairs if turn is not None]
        if not met:
            break
        joined[met[0][0]] = met[0][1]
        waiting.remove(met[0][0])
    if len(joined) < 2:
        return []
    return [
        Hung(name, lenses[name], invert_pose(joined[name] @ _floor_from_camera(known[name])))
        for name in known
        if name in joined
    ]


def _floor_from_camera(one: Alignment) -> Array:
    """In a frame of the camera's own: its foot the origin, z up, x as in its picture."""
    assert one.down is not None
    assert one.height_m is not None
    x = np.array([1.0, 0.0, 0.0]) - one.down[0] * one.down
    x /= np.linalg.norm(x)
    axes = np.column_stack([x, np.cross(-one.down, x), -one.down])
    return invert_pose(make_pose(axes, one.height_m * one.down))


def _turn(one: Alignment, other: Alignment) -> Array | None:
    """From the floor frame of one camera to that of another, (4, 4)."""
    pairs = [(a, b) for a in one.lying for b in other.lying if _same(a, b)]
    if len(pairs) < 2:
        return None
    here, there = (
        transform(_floor_from_camera(camera), np.array([pair[n].point_m for pair in pairs]))[:, :2]
        for n, camera in enumerate((one, other))
    )
    # As complex numbers: the best turn is the direction of their product.
    a, b = (points_m @ np.array([1, 1j]) for points_m in (here, there))
    product = np.vdot(a - a.mean(), b - b.mean())
    if np.abs(a - a.mean()).max() < _APART_M / 2 or product == 0:
        return None
    turn = product / abs(product)
    shift = b.mean() - turn * a.mean()
    if np.abs(turn * a + shift - b).max() > _ALIKE_M:
        return None
    rotation = np.array([[turn.real, -turn.imag, 0.0], [turn.imag, turn.real, 0.0], [0.0, 0.0, 1.0]])
    return make_pose(rotation, np.array([shift.real, shift.imag, 0.0]))


def _same(one: Lying, other: Lying) -> bool:
    """Whether two cameras saw one marker at one place."""
    return one.marker_id == other.marker_id and one.start_ns <= other.end_ns and other.start_ns <= one.end_ns
