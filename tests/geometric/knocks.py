"""Drives without images under cameras that are knocked, warm up, or are refocused."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import Camera, sees
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.messages import Array, Marker, Markers, Message, ReferenceMarker
from ipsys_log.messages.channels import MARKERS, RIG
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import project
from ipsys_log.vision.poses import make_pose, rotation, transform
from tests.geometric.corner_noise import corner_covariances, draw_corner_noise, edge_sigma_px
from tests.geometric.lab import GeometricLab, PlacedMarkers, camera_poses
from tests.geometric.session import MARKERS_RUN, geometric_rig
from tests.geometric.sightings import CameraSightings, drive_times_ns, simulate_sightings

_LATENCY_NS = 50_000_000
_WARMING_S = 1200.0
# Poses of a marker at times (n,) of the drive, in s.
Place = Callable[[Array], PlacedMarkers]


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A change of a camera from a time of the drive on.

    ``turn_rad`` is a rotation vector about the axes of the camera, ``shift_m`` a motion in the world. With
    ``over_s``, the motion is gradual. ``zoom`` is a relative change of the focal length, ``centre_px`` a
    shift of the principal point, ``clock_s`` a step of the stamps.
    """

    camera: str
    at_s: float
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    zoom: float = 0.0
    centre_px: tuple[float, float] = (0.0, 0.0)
    clock_s: float = 0.0
    over_s: float = 0.0


def lying(x_m: float, y_m: float, moves_at_s: float = np.inf) -> Place:
    """Return the poses of a marker on the floor that is moved by 4.5 mm at a time."""
    turn = rotation(np.array([0.0, 0.0, x_m]))

    def place(times_s: Array) -> PlacedMarkers:
        centres_m = np.tile([x_m, y_m, 0.0], (len(times_s), 1))
        centres_m[times_s > moves_at_s] += [0.004, 0.002, 0.0]
        return PlacedMarkers(centres_m, np.tile(turn, (len(times_s), 1, 1)))

    return place


def keep_markers(messages: Iterable[Message], ids: Collection[int]) -> Iterator[Message]:
    """Yield messages whose frames have only some markers."""
    for message in messages:
        frame = message.payload
        if isinstance(frame, Markers):
            frame = replace(frame, markers=tuple(one for one in frame.markers if one.id in ids))
        yield replace(message, payload=frame)


def disturb(camera: Camera, change: Disturbance) -> Camera:
    """Return a camera after a change of its pose and its focal length."""
    turned = rotation(np.array(change.turn_rad)) @ camera.camera_from_world[:3, :3]
    origin_m = camera.origin_m + change.shift_m
    K = camera.lens.K.copy()
    K[0, 0] *= 1 + change.zoom
    K[1, 1] *= 1 + change.zoom
    K[:2, 2] += change.centre_px
    return replace(
        camera,
        camera_from_world=make_pose(turned, -turned @ origin_m),
        lens=replace(camera.lens, K=K),
    )


def drive_messages(
    lab: GeometricLab,
    changes: Sequence[Disturbance] = (),
    warming_px: float = 0.0,
    others: Mapping[int, Place] | None = None,
    references: Sequence[int] = (),
) -> Iterator[Message]:
    """Yield the rig, and the markers of the drive of a lab without calibration points, in log order.

    Parameters
    ----------
    lab : its calibration points are left out.
    changes : of its cameras, in order of time.
    warming_px : by how much the principal points move, with a time constant of 20 minutes.
    others : further markers by id: their poses at times (n,) of the drive, in s.
    references : ids of those that are reference markers of the rig.
    """
    lab = replace(lab, points=())
    rig = replace(geometric_rig(lab), reference_markers=tuple(ReferenceMarker(one) for one in references))
    yield Message(RIG.topic, EPOCH_NS, EPOCH_NS, rig)
    rows = []
    for number, camera in enumerate(lab.cameras):
        for stamp_ns, frame in _frames(lab, camera, number, changes, warming_px, others or {}):
            rows.append((stamp_ns + _LATENCY_NS, number, frame, camera.name))
    rows.sort(key=lambda row: row[:2])
    log_time_ns = EPOCH_NS
    for arrival_ns, _, frame, name in rows:
        log_time_ns = max(arrival_ns, log_time_ns + 1)
        yield Message(MARKERS.topic_of(MARKERS_RUN, name), log_time_ns, frame.timestamp, frame, name)


def _frames(
    lab: GeometricLab,
    camera: Camera,
    number: int,
    changes: Sequence[Disturbance],
    warming_px: float,
    others: Mapping[int, Place],
) -> Iterator[tuple[int, Markers]]:
    own = [change for change in changes if change.camera == camera.name]
    start_ns = int(drive_times_ns(lab)[0])
    bounds = [0, *(start_ns + round(change.at_s * NS_PER_S) for change in own), 2**62]
    angle = np.random.default_rng([lab.settings.lab.seed, number]).uniform(0, 2 * np.pi)
    aside_px = warming_px * np.array([np.cos(angle), np.sin(angle)])
    clock_ns = 0
    stamps_ns = drive_times_ns(lab) + lab.frame_delays_ns[camera.name] + lab.clock_offsets_ns[camera.name]
    for first_ns, last_ns, change in zip(bounds[:-1], bounds[1:], [None, *own], strict=True):
        if change is not None:
            before, camera = camera, disturb(camera, change)
            clock_ns += round(change.clock_s * NS_PER_S)
        seen = simulate_sightings(lab, camera)
        if change is not None and change.over_s:
            share = (seen.stamps_ns - first_ns) / NS_PER_S / change.over_s
            seen = _mix(simulate_sightings(lab, before), seen, np.clip(share, 0.0, 1.0))
        seen = _select(seen, (seen.stamps_ns >= first_ns) & (seen.stamps_ns < last_ns))
        level = 1 - np.exp(-(seen.stamps_ns - start_ns) / NS_PER_S / _WARMING_S)
        corners_px = seen.corners_px + level[:, None, None] * aside_px
        ends = np.searchsorted(seen.stamps_ns, seen.stamps_ns, side="right")
        starts = np.searchsorted(seen.stamps_ns, seen.stamps_ns, side="left")
        by_stamp = dict(
            zip(seen.stamps_ns.tolist(), zip(starts.tolist(), ends.tolist(), strict=True), strict=True)
        )
        timed = lab.settings.row_time_in_rig and lab.settings.lab.row_time_ns > 0
        own_ns = stamps_ns[(stamps_ns >= first_ns) & (stamps_ns < last_ns)]
        further = _other_markers(lab, camera, number, others, own_ns, start_ns)
        for stamp_ns in own_ns.tolist():
            start, end = by_stamp.get(stamp_ns, (0, 0))
            markers = tuple(
                Marker(
                    int(seen.ids[row]),
                    corners_px[row],
                    seen.covariances_px2[row],
                    int(seen.offsets_ns[row]) if timed else None,
                )
                for row in range(start, end)
            )
            markers += tuple(further.get(stamp_ns, ()))
            size = lab.settings.lab.width, lab.settings.lab.height
            yield stamp_ns + clock_ns, Markers(stamp_ns + clock_ns, markers, *size)


def _other_markers(
    lab: GeometricLab,
    camera: Camera,
    number: int,
    others: Mapping[int, Place],
    stamps_ns: NDArray[np.int64],
    start_ns: int,
) -> dict[int, list[Marker]]:
    """Return further markers by the stamps of the frames."""
    rng, length_m = np.random.default_rng([7, number, len(stamps_ns)]), lab.settings.lab.marker_length_m
    found: dict[int, list[Marker]] = defaultdict(list)
    for marker_id, place in sorted(others.items()):
        placed = place((stamps_ns - start_ns) / NS_PER_S)
        corners_m = placed.corners_m(1.03 * length_m)
        seen = np.flatnonzero(sees(camera, corners_m.reshape(-1, 3)).reshape(-1, 4).all(axis=1))
        if not len(seen):
            continue
        placed = PlacedMarkers(placed.centres_m[seen], placed.rotations[seen])
        rotations, centres_m = camera_poses(camera, placed)
        sigma_px = edge_sigma_px(lab.settings.lab)
        covariances = corner_covariances(camera.lens, rotations, centres_m, length_m, sigma_px)
        points_c = transform(camera.camera_from_world, placed.corners_m(length_m).reshape(-1, 3))
        corners_px = project(points_c, camera.lens).reshape(-1, 4, 2)
        corners_px = corners_px + draw_corner_noise(covariances, np.arange(len(seen)), rng)
        for row, index in enumerate(seen.tolist()):
            marker = Marker(marker_id, corners_px[row], covariances[row])
            found[int(stamps_ns[index])].append(marker)
    return found


def _mix(first: CameraSightings, second: CameraSightings, shares: Array) -> CameraSightings:
    """Return sightings on the way between two near poses of a camera; ``shares`` (n,) of the second one."""
    keys = [list(zip(one.placements.tolist(), one.ids.tolist(), strict=True)) for one in (first, second)]
    rows = {key: row for row, key in enumerate(keys[0])}
    kept = np.array([row for row, key in enumerate(keys[1]) if key in rows], dtype=np.int64)
    others = np.array([rows[keys[1][row]] for row in kept.tolist()], dtype=np.int64)
    share, end = shares[kept, None, None], _select(second, kept)
    return replace(end, corners_px=(1 - share) * first.corners_px[others] + share * end.corners_px)


def _select(seen: CameraSightings, rows: NDArray[Any]) -> CameraSightings:
    own = {one.name: getattr(seen, one.name)[rows] for one in fields(seen) if one.name != "camera"}
    return CameraSightings(seen.camera, **own)
