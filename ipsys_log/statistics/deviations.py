"""Deviations between the cameras of a joint model, and their stream from the markers in images.

The size of a marker in one image gives its height, which deviates from that of the rig. The positions and
headings of a robot by two cameras deviate from each other. The corners of a reference marker deviate from
where they were. These values repeat with the place: they come from the errors of the calibration, of the
lenses and of the floor. The height and the print of each robot's marker add a constant.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.locate import corner_covariances, exposure_offset_ns
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import move_camera
from ipsys_log.messages import Array, Indices, Marker, Markers, Message, Rig, Times
from ipsys_log.statistics.level_sightings import FixedMarker, ImagedMarkers, LevelSightings, observe_level
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import body_shapes

# The log time between two steps, at absolute multiples.
STEP_NS = NS_PER_S // 2
# A marker counts once in each slot of time for each camera.
_SLOT_NS = NS_PER_S // 10
# After so many slots without a sighting, a robot enters an image. So many slots later, its marker has a
# velocity, and so corrected rows of the shutter.
_AWAY_SLOTS, _ENTRY_SLOTS = 8, 4
# Sightings are compared when those of all cameras around them are there, and then forgotten.
_DELAY_NS, _KEPT_NS = 400_000_000, 3 * NS_PER_S // 2
# Relative error of a motion in the image, by the unknown distance of a reference marker.
_DEPTH_SHARE = 0.01
# Steps whose shares of level markers are kept. A robot has a marker with at least so many sightings, and this
# share of level ones.
_FITS, _FEWEST, _USUALLY = 6, 20, 0.8
# A place is a square of this side.
_PLACE_M = 0.25
# A position of one camera between four sightings of the other one: longest time between two of them.
_LONGEST_GAP_NS = NS_PER_S // 4
_NODES = np.array([-2, -1, 0, 1])


class DeviationKind(NamedTuple):
    """A kind of deviation with k values.

    Attributes
    ----------
    name : in texts.
    passes : (k,), standard deviations between two passes over a place, beside the noise of the corners.
    places : (k,), standard deviations of a place before its first pass.
    """

    name: str
    passes: Array
    places: Array


# In m and rad. In simulated labs with a wobble of 0.2 degrees, passes differ by 0.1 mm and 0.3 mm (rise).
PAIR = DeviationKind("pair", np.array([3e-4, 3e-4, 5e-4]), np.array([1.5e-3, 1.5e-3, 2e-3]))
RISE = DeviationKind("rise", np.array([5e-4]), np.array([2e-3]))
# In px: slow changes by light. Before its first sighting, a reference marker can be anywhere.
REFERENCE = DeviationKind("reference", np.full(8, 0.03), np.full(8, 1e4))

PlaceKey = tuple[str, tuple[str, ...], int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """The mean deviation of a marker at a place in a step of time.

    Attributes
    ----------
    kind, marker_id : of the deviation; the robot or reference marker.
    cameras : one camera, or two: the value is that of the second one minus that of the first.
    place : the number of its square along x and y; a reference marker is its own place.
    value, noise : (k,), the mean, and the variance by the noise of the corners.
    by_motions : slopes (k, 6) by a motion of each camera.
    by_marker : (k, p), by the height of a robot's marker, or by a motion and turn of a reference marker.
    by_clock : (k, 1), by a later stamp of the second camera; None for one camera.
    """

    kind: DeviationKind
    marker_id: int
    cameras: tuple[str, ...]
    place: tuple[int, int]
    value: Array
    noise: Array
    by_motions: tuple[Array, ...]
    by_marker: Array
    by_clock: Array | None = None

    @property
    def key(self) -> PlaceKey:
        """The place with its cameras."""
        return self.kind.name, self.cameras, *self.place

    @property
    def slopes(self) -> dict[str, Array]:
        """The slopes (k, 6) by a motion of each camera, with their signs."""
        signs = (-1.0, 1.0)[-len(self.cameras) :]
        rows = zip(self.cameras, signs, self.by_motions, strict=True)
        return {camera: sign * by_motion for camera, sign, by_motion in rows}


def _find_deviations(
    sightings: Mapping[str, LevelSightings], camera: str, others: Sequence[str], first_ns: int, last_ns: int
) -> Iterator[Deviation]:
    """Yield the deviations of a camera, by itself and from others, after a time and until another one."""
    yield from _rises(camera, sightings[camera], first_ns, last_ns)
    for other in others:
        yield from _pairs((other, camera), sightings[other], sightings[camera], first_ns, last_ns)


def _rises(camera: str, seen: LevelSightings, first_ns: int, last_ns: int) -> Iterator[Deviation]:
    rows = np.flatnonzero((seen.times_ns > first_ns) & (seen.times_ns <= last_ns))
    for marker_id, place, numbers in _by_place(seen.ids[rows], seen.poses[rows]):
        own = rows[numbers]
        yield Deviation(
            RISE,
            marker_id,
            (camera,),
            place,
            seen.rises_m[own].mean(keepdims=True),
            seen.variances[own, 3].mean(keepdims=True) / len(own),
            (seen.by_motion[own, 3:].mean(axis=0),),
            np.ones((1, 1)),
        )


def _by_place(ids: Times, poses: Array) -> Iterator[tuple[int, tuple[int, int], Indices]]:
    """Yield markers and places, with the rows (m,) of each."""
    squares = np.floor(poses[:, :2] / _PLACE_M).astype(np.int64)
    groups: dict[tuple[int, int, int], list[int]] = defaultdict(list)
    for row, key in enumerate(zip(ids.tolist(), *squares.T.tolist(), strict=True)):
        groups[key].append(row)
    for (marker_id, i, j), own in groups.items():
        yield marker_id, (i, j), np.array(own)


def _pairs(
    cameras: tuple[str, str], first: LevelSightings, second: LevelSightings, first_ns: int, last_ns: int
) -> Iterator[Deviation]:
    """Yield the deviations of the second camera from a cubic through four sightings of the first."""
    inside = (second.times_ns > first_ns) & (second.times_ns <= last_ns)
    for marker_id in np.intersect1d(first.ids, second.ids[inside]).tolist():
        known, wanted = (
            np.flatnonzero(first.ids == marker_id),
            np.flatnonzero(inside & (second.ids == marker_id)),
        )
        times_ns = first.times_ns[known]
        after = np.searchsorted(times_ns, second.times_ns[wanted])
        between = (after >= 2) & (after < len(known) - 1)
        wanted, nodes = wanted[between], after[between, None] + _NODES
        near = (np.diff(times_ns[nodes], axis=1) <= _LONGEST_GAP_NS).all(axis=1)
        wanted, nodes = wanted[near], nodes[near]
        if len(wanted):
            ahead_s = (times_ns[nodes] - second.times_ns[wanted, None]) / NS_PER_S
            yield from _compare(cameras, marker_id, first, second, known[nodes], wanted, ahead_s)


def _compare(
    cameras: tuple[str, str],
    marker_id: int,
    first: LevelSightings,
    second: LevelSightings,
    nodes: Indices,
    wanted: Indices,
    ahead_s: Array,
) -> Iterator[Deviation]:
    """Yield the deviations of sightings ``wanted`` (m,) from those at ``nodes`` (m, 4)."""
    weights = _lagrange(ahead_s)
    poses = second.poses[wanted, None] - first.poses[nodes]
    poses[..., 2] = (poses[..., 2] + np.pi) % (2 * np.pi) - np.pi
    values = np.einsum("mn,mnk->mk", weights, poses)
    slopes = np.einsum("mn,mnki->mki", weights, first.by_motion[nodes, :3]), second.by_motion[wanted, :3]
    by_height = np.zeros((len(wanted), 3, 1))
    by_height[:, :2, 0] = second.by_height[wanted] - np.einsum("mn,mnk->mk", weights, first.by_height[nodes])
    noise = second.variances[wanted, :3] + np.einsum("mn,mnk->mk", weights**2, first.variances[nodes, :3])
    speeds = (poses[:, 1] - poses[:, 2]) / (ahead_s[:, 2] - ahead_s[:, 1])[:, None]
    for _, place, own in _by_place(second.ids[wanted], second.poses[wanted]):
        yield Deviation(
            PAIR,
            marker_id,
            cameras,
            place,
            values[own].mean(axis=0),
            noise[own].mean(axis=0) / len(own),
            (slopes[0][own].mean(axis=0), slopes[1][own].mean(axis=0)),
            by_height[own].mean(axis=0),
            -speeds[own].mean(axis=0)[:, None],
        )


def _lagrange(ahead_s: Array) -> Array:
    """Return the weights (m, 4) of the values at times (m, 4) for that at 0, by a cubic."""
    weights = np.ones_like(ahead_s)
    for node in range(ahead_s.shape[1]):
        for other in range(ahead_s.shape[1]):
            if other != node:
                weights[:, node] *= ahead_s[:, other] / (ahead_s[:, other] - ahead_s[:, node])
    return weights


@dataclass(slots=True, eq=False)
class DeviationStep:
    """The deviations in half a second: its log time, and the last instant of its sightings."""

    time_ns: int
    last_ns: int
    deviations: list[Deviation]


class DeviationStream:
    """The stream of deviations from markers in log order, in steps of log time.

    Parameters
    ----------
    cameras : joint models by camera; the deviations are those from their poses.
    """

    def __init__(self, cameras: Mapping[str, JointModel]) -> None:
        self.cameras = {name: one.without_modes() for name, one in cameras.items()}
        # By camera, the numbers of level sightings and of all sightings of each robot in the last steps.
        self.fits: dict[str, deque[dict[int, tuple[int, int]]]] = {}
        self.rig: Rig | None = None
        self._on_bodies: set[int] = set()
        self._ignored_ns: dict[int, int] = {}
        self._delays_ns: dict[str, int] = {}
        self._waiting: dict[str, list[tuple[int, Marker]]] = {}
        self._slots: dict[tuple[str, int], int] = {}
        self._entered: dict[tuple[str, int], int] = {}
        self._sightings: dict[str, LevelSightings] = {}
        self._fixed: dict[tuple[str, int], FixedMarker] = {}
        self._seen, self._level = Counter[int](), Counter[int]()
        self._number: int | None = None
        self._newest_ns = self._done_ns = 0

    def use_rig(self, rig: Rig) -> list[int]:
        """Use a rig; return the markers with another height or side than before."""
        before, self.rig = self.rig, rig
        shapes = {shape.robot for shape in body_shapes(rig) if not shape.is_level}
        self._on_bodies = {marker.id for marker in rig.markers if marker.robot in shapes}
        ids = [] if before is None else [marker.id for marker in rig.markers]
        return [one for one in ids if _size_of(before, one) != _size_of(rig, one)]

    def move(self, camera: str, motion: Array) -> None:
        """Move a camera (6,): the next sightings are compared with another pose."""
        self.cameras[camera] = move_camera(self.cameras[camera], motion)
        self._sightings.pop(camera, None)

    def delay(self, camera: str, delay_ns: int) -> None:
        """Add a delay to the stamps of a camera from now on."""
        self._delays_ns[camera] = self._delays_ns.get(camera, 0) + delay_ns
        self._sightings.pop(camera, None)

    def forget_clocks(self) -> None:
        """Begin another recording: its clocks have no delay."""
        self._delays_ns, self._sightings = {}, {}

    def ignore(self, marker_id: int, until_ns: int) -> None:
        """Leave out a marker until a log time; a reference marker has a new place."""
        self._ignored_ns[marker_id] = until_ns
        self._fixed = {key: fixed for key, fixed in self._fixed.items() if key[1] != marker_id}

    def collect(self, message: Message) -> bool:
        """Collect the markers of a frame; return whether they complete a step."""
        camera, rig = str(message.camera), self.rig
        if camera not in self.cameras or rig is None:
            return False
        model, delay_ns = self.cameras[camera], self._delays_ns.get(camera, 0)
        frame: Markers = message.payload
        for marker in frame.markers:
            time_ns = message.publish_time_ns + exposure_offset_ns(model, marker) + delay_ns
            slot, key = time_ns // _SLOT_NS, (camera, marker.id)
            is_known = rig.is_reference(marker.id) or rig.height_of(marker.id) is not None
            is_ignored = self._ignored_ns.get(marker.id, 0) > message.log_time_ns
            if (
                is_known
                and not is_ignored
                and marker.id not in self._on_bodies
                and slot > self._slots.get(key, -1)
            ):
                if slot > self._slots.get(key, -_AWAY_SLOTS) + _AWAY_SLOTS:
                    self._entered[key] = slot
                self._slots[key] = slot
                if slot < self._entered[key] + _ENTRY_SLOTS and not rig.is_reference(marker.id):
                    continue
                self._waiting.setdefault(camera, []).append((time_ns, marker))
                self._newest_ns = max(self._newest_ns, time_ns)
        number = message.log_time_ns // STEP_NS
        before, self._number = self._number, max(number, self._number or 0)
        return before is not None and number > before

    def finish_step(self) -> Iterator[DeviationStep | None]:
        """Yield the step of the markers so far; None before it are pauses, in which others can work."""
        assert self.rig is not None
        assert self._number is not None
        waiting, self._waiting = self._waiting, {}
        first_ns, self._done_ns = self._done_ns, max(self._newest_ns - _DELAY_NS, self._done_ns)
        step = DeviationStep(self._number * STEP_NS, self._done_ns, [])
        for camera, rows in waiting.items():
            step.deviations += self._observe(self.rig, camera, rows)
            yield None
        for number, camera in enumerate(sorted(self._sightings)):
            others = sorted(self._sightings)[:number]
            step.deviations += _find_deviations(self._sightings, camera, others, first_ns, step.last_ns)
            yield None
        yield step

    def _observe(self, rig: Rig, camera: str, rows: Sequence[tuple[int, Marker]]) -> Iterator[Deviation]:
        """Linearise the new sightings of a camera; yield the deviations of its reference markers."""
        model, robots = self.cameras[camera], [row for row in rows if not rig.is_reference(row[1].id)]
        if robots:
            heights_m = np.array([rig.height_of(marker.id) for _, marker in robots], dtype=np.float64)
            new = observe_level(model, _seen(rig, robots), heights_m)
            self._count_level(camera, [marker.id for _, marker in robots], new.ids.tolist())
            known = self._sightings.get(camera)
            both = new if known is None else known.join(new)
            self._sightings[camera] = both.select(both.times_ns > self._newest_ns - _KEPT_NS)
        for marker_id in sorted({marker.id for _, marker in rows if rig.is_reference(marker.id)}):
            seen = _seen(rig, [row for row in rows if row[1].id == marker_id])
            fixed = self._fixed.get((camera, marker_id)) or FixedMarker.find(model, seen)
            if fixed is not None:
                self._fixed[camera, marker_id] = fixed
                value, by_motion, by_marker = fixed.compare(model, np.median(seen.corners_px, axis=0))
                noise = seen.covariances_px2.diagonal(axis1=1, axis2=2).mean(axis=0) / len(seen.ids)
                noise = noise + (_DEPTH_SHARE * np.linalg.norm(value) / 2) ** 2
                yield Deviation(
                    REFERENCE, marker_id, (camera,), (marker_id, 0), value, noise, (by_motion,), by_marker
                )

    def robots(self) -> list[int]:
        """Return the markers that are nearly always level."""
        return [
            one
            for one, count in self._seen.items()
            if count > _FEWEST and self._level[one] > _USUALLY * count
        ]

    def _count_level(self, camera: str, ids: Sequence[int], level: Sequence[int]) -> None:
        """Note how many of the markers that are nearly always level are level now."""
        counts, level_counts = Counter(ids), Counter(level)
        robots = {one: (level_counts[one], counts[one]) for one in self.robots() if one in counts}
        fits = self.fits.setdefault(camera, deque(maxlen=_FITS))
        if robots:
            fits.append(robots)
        self._seen.update(counts)
        self._level.update(level_counts)


def _size_of(rig: Rig | None, marker_id: int) -> tuple[float | None, float] | None:
    return None if rig is None else (rig.height_of(marker_id), rig.length_of(marker_id))


def _seen(rig: Rig, rows: Sequence[tuple[int, Marker]]) -> ImagedMarkers:
    markers = [marker for _, marker in rows]
    return ImagedMarkers(
        np.array([time_ns for time_ns, _ in rows], dtype=np.int64),
        np.array([marker.id for marker in markers], dtype=np.int64),
        np.array([marker.corners_px for marker in markers], dtype=np.float64),
        corner_covariances([marker.covariance_px2 for marker in markers]),
        np.array([rig.length_of(marker.id) for marker in markers]),
    )
