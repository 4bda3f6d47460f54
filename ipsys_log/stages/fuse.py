"""One pose per robot from the positions of all cameras that see it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    STAMP_UNRELIABLE,
    Event,
    FrameTransform,
    FrameTransforms,
    Message,
    Position,
    Quaternion,
    Rig,
    Track,
    Tracks,
    Vector3,
)
from ipsys_log.messages.channels import EVENTS, POSES, POSITIONS, RIG, TRACKS
from ipsys_log.messages.stage import Plan, Stage, StageView

__all__ = ["STAGE", "Fuse", "fuse_positions"]


class Fuse:
    """The stage *fuse*: it averages positions of one instant, weighted by their inverse covariances.

    Every message of positions gives a pose of each robot in it. The pose uses this camera and the other
    cameras that saw the robot within ``window_ns``. At 2 m/s a robot moves 1 cm in 5 ms, so unsynchronized
    cameras are not averaged. Synchronized cameras give one pose each; the last pose uses all cameras.

    A pose is valid for the instant at which its marker was exposed. With time offsets (rolling shutter), each
    marker of a frame gets its own message, earlier ones first. Two such cameras see a robot in different
    rows, up to 30 ms apart; beyond the window they are not averaged either.

    Late frames have wrong times; an event of their camera names them. Their positions are in no pose.
    """

    def __init__(self, run: str, window_ns: int = 5_000_000) -> None:
        self._run = run
        self._window_ns = window_ns
        self._rig: Rig | None = None
        self._latest: dict[int, dict[str, tuple[int, Position]]] = {}
        # By camera, the start and end time of its last late frames; None if there is no end yet.
        self._late_ns: dict[str, tuple[int, int | None]] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            self._rig = message.payload
            return
        if isinstance(message.payload, Event):
            self._note_late(message.payload)
            return
        if self._is_late(message):
            return
        if self._rig is None:
            raise IpsysError("the log has no rig (robots and their markers): give one with --rig lab.toml")
        tracks_by_time: dict[int, list[Track]] = {}
        for position in message.payload.positions:
            now_ns = message.publish_time_ns + (position.time_offset_ns or 0)
            tracks_by_time.setdefault(now_ns, []).append(
                self._track(position, str(message.camera), now_ns, self._rig)
            )
        for now_ns, tracks in sorted(tracks_by_time.items()):
            yield Tracks(now_ns, tuple(tracks))
            yield FrameTransforms(tuple(_transform(track, self._run, now_ns) for track in tracks))

    def _note_late(self, event: Event) -> None:
        if event.kind == STAMP_UNRELIABLE and event.camera is not None and event.start is not None:
            self._late_ns[event.camera] = event.start, event.end

    def _is_late(self, message: Message) -> bool:
        start_ns, end_ns = self._late_ns.get(str(message.camera), (None, None))
        time_ns = message.publish_time_ns
        return start_ns is not None and start_ns <= time_ns and (end_ns is None or time_ns <= end_ns)

    def _track(self, position: Position, camera: str, now_ns: int, rig: Rig) -> Track:
        seen = self._latest.setdefault(position.id, {})
        seen[camera] = (now_ns, position)
        together = {
            name: recent
            for name, (time_ns, recent) in sorted(seen.items())
            if abs(now_ns - time_ns) <= self._window_ns
        }
        fused = fuse_positions(list(together.values()))
        return Track(
            rig.robot_of(position.id),
            position.id,
            fused.x_m,
            fused.y_m,
            fused.z_m,
            fused.heading_rad,
            fused.covariance_m2,
            tuple(together),
            _any_inside([recent.inside for recent in together.values()]),
        )


def _any_inside(flags: list[bool | None]) -> bool | None:
    known = [flag for flag in flags if flag is not None]
    return any(known) if known else None


def fuse_positions(positions: list[Position]) -> Position:
    """Return the best single position of one marker at one instant.

    Parameters
    ----------
    positions : at least one, of one marker id, in m.

    Returns
    -------
    Position : weighted by inverse covariances if every position has a covariance, else the plain mean
        (without a covariance). The heading is the circular mean of the known headings.

    Examples
    --------
    >>> near, far = Position(1, 0.0, 0, 0, None, np.eye(3)), Position(1, 3.0, 0, 0, None, 2 * np.eye(3))
    >>> round(fuse_positions([near, far]).x_m, 9)
    1.0
    """
    if len(positions) == 1:
        return positions[0]
    points = np.array([(p.x_m, p.y_m, p.z_m) for p in positions])
    weights, covariance_m2 = _weights(positions), None
    if weights is not None:
        covariance_m2 = np.linalg.inv(weights.sum(axis=0))
        mean = covariance_m2 @ np.einsum("nij,nj->i", weights, points)
    else:
        mean = points.mean(axis=0)
    headings = [p.heading_rad for p in positions if p.heading_rad is not None]
    along = complex(np.exp(1j * np.array(headings)).sum())
    # Opposite headings have no mean.
    heading_rad = float(np.angle(along)) if abs(along) > 1e-9 else None
    x_m, y_m, z_m = mean.tolist()
    return Position(positions[0].id, x_m, y_m, z_m, heading_rad, covariance_m2)


def _weights(positions: list[Position]) -> NDArray[np.float64] | None:
    """Return inverse covariances (n, 3, 3); None unless every position has a valid covariance."""
    present = [p.covariance_m2 for p in positions if p.covariance_m2 is not None]
    covariances = np.array(present)
    if len(present) < len(positions) or not np.isfinite(covariances).all():
        return None
    least = np.linalg.eigvalsh(covariances)[:, 0]  # of the lower triangles
    return np.asarray(np.linalg.inv(covariances), dtype=np.float64) if (least > 0).all() else None


def _transform(track: Track, run: str, time_ns: int) -> FrameTransform:
    # A transform must have a rotation; /runs/<run>/tracks shows that the heading is missing.
    half_rad = (track.heading_rad or 0.0) / 2
    return FrameTransform(
        time_ns,
        "world",
        f"{run}/{track.robot}",
        Vector3(track.x_m, track.y_m, track.z_m),
        Quaternion(0.0, 0.0, float(np.sin(half_rad)), float(np.cos(half_rad))),
    )


def _plan(view: StageView, _options: Mapping[str, str]) -> Plan:
    has_late_frames = any(event.kind == STAMP_UNRELIABLE for event in view.payloads(EVENTS))
    return Plan(
        run=view.run(POSITIONS),
        parameters={},
        # A log without such events keeps its existing runs.
        reads=(RIG, POSITIONS, *([EVENTS] if has_late_frames else [])),
        step=Fuse,
    )


STAGE = Stage(
    name="fuse",
    versions={"fuse": 1},
    reads=(RIG, POSITIONS, EVENTS),
    writes=(TRACKS, POSES),
    plan=_plan,
    rig_part=lambda rig, method: {(m.id, m.robot) for m in rig.markers},
    per_camera=False,
)
