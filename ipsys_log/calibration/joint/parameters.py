"""Unknowns of the joint calibration: their order, their prior, and a state of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.floor_field import FloorField
from ipsys_log.calibration.joint.observations import CameraPrior, Observations, lens_model_of
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.messages import Array
from ipsys_log.vision.poses import rotate

_FIXED = 0.0


@dataclass(frozen=True, slots=True)
class CameraBlock:
    """Columns of a camera among the global unknowns.

    They are: rotation (3, a small turn in camera coordinates), position in the world (3), intrinsics (q),
    edge offset in px, clock offset in s, row time in s. The clock offset is that of the last recording.
    """

    start: int
    model: LensModel

    @property
    def lens(self) -> slice:
        """The columns of the intrinsics."""
        return slice(self.start + 6, self.edge)

    @property
    def edge(self) -> int:
        """The column of the edge offset; clock offset and row time follow."""
        return self.start + 6 + len(self.model.names)

    @property
    def stop(self) -> int:
        """The first column after the block."""
        return self.edge + 3


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Order of the global unknowns: cameras, bodies' scales and heights, floor, tape, former clocks.

    ``mean`` (g,) and ``sigma`` (g,) are the prior. A sigma of 0 keeps an unknown constant; infinity is no
    prior.
    """

    cameras: tuple[CameraBlock, ...]
    bodies: int
    floor: FloorField
    mean: Array
    sigma: Array

    @property
    def scales(self) -> slice:
        """The columns of the bodies' scales."""
        return slice(self.cameras[-1].stop, self.cameras[-1].stop + self.bodies)

    @property
    def heights(self) -> slice:
        """The columns of the heights at which robots carry bodies."""
        return slice(self.scales.stop, self.scales.stop + self.bodies)

    @property
    def modes(self) -> slice:
        """The columns of the floor's modes."""
        return slice(self.heights.stop, self.heights.stop + self.floor.count)

    @property
    def tape(self) -> slice:
        """The columns of the scale of the tape, and of the scale of the reference points in the rig."""
        return slice(self.modes.stop, self.modes.stop + 2)

    def clock(self, camera: int, recording: int) -> int:
        """Return the column of the clock offset of a camera in a recording."""
        former = self.tape.stop + recording * len(self.cameras)
        return self.cameras[camera].edge + 1 if former == len(self.mean) else former + camera

    @property
    def free(self) -> NDArray[np.bool_]:
        """A mask (g,) of the unknowns that the fit estimates."""
        return np.asarray(self.sigma > 0)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of all unknowns.

    Attributes
    ----------
    values : (g,), the global unknowns. The three of a camera's rotation are unused.
    camera_turns : (c, 3, 3), ``camera_from_world``.
    positions_m, turns : (t, 3) and (t, 3, 3), poses of the stationary bodies in the world.
    knots : (k, 3), knots of the paths over the floor: x, y in m and heading in rad.
    free_knots : (f, 6), knots of free paths: position in m, and rotation vector from the mean orientation.
    """

    values: Array
    camera_turns: Array
    positions_m: Array
    turns: Array
    knots: Array
    free_knots: Array = field(default_factory=lambda: np.zeros((0, 6)))

    def moved(self, layout: Layout, by_global: Array, by_local: Array) -> State:
        """Return the state after a step: (g,) of the global and (l,) of the local unknowns."""
        poses, knots, free_knots = np.split(
            by_local, [6 * len(self.positions_m), 6 * len(self.positions_m) + self.knots.size]
        )
        poses = poses.reshape(-1, 6)
        turned = np.stack([by_global[block.start : block.start + 3] for block in layout.cameras])
        return replace(
            self,
            values=self.values + by_global,
            camera_turns=rotate(turned) @ self.camera_turns,
            positions_m=self.positions_m + poses[:, :3],
            turns=rotate(poses[:, 3:]) @ self.turns,
            knots=self.knots + knots.reshape(-1, 3),
            free_knots=self.free_knots + free_knots.reshape(-1, 6),
        )


def make_layout(
    observations: Observations, settings: JointSettings, floor: FloorField, moving: bool
) -> Layout:
    """Return the order and the prior of the global unknowns; clocks are free if bodies are ``moving``."""
    blocks, means, sigmas, start = [], [], [], 0
    clocks_s: Array = np.where(_free_clocks(observations) & moving, settings.clock_sigma_s, _FIXED)
    for camera, clock_s in zip(observations.cameras, clocks_s[-1].tolist(), strict=True):
        block = CameraBlock(start, lens_model_of(camera.lens))
        mean, sigma = _camera_prior(camera, settings, clock_s, moving)
        blocks.append(block)
        means.append(mean)
        sigmas.append(sigma)
        start = block.stop
    bodies = observations.bodies
    heights_m = np.array([body.height_m or 0.0 for body in bodies])
    height_sigmas_m = [body.height_sigma_m if body.height_m is not None else _FIXED for body in bodies]
    former_s: Array = clocks_s[:-1].reshape(-1)
    means += [np.ones(len(bodies)), heights_m, np.zeros(floor.count), np.ones(2), np.zeros(len(former_s))]
    sigmas += [
        np.array([body.scale_sigma for body in bodies]),
        np.array(height_sigmas_m) if moving else np.zeros(len(bodies)),
        np.ones(floor.count),
        tape_sigmas(observations),
        former_s,
    ]
    return Layout(tuple(blocks), len(bodies), floor, np.concatenate(means), np.concatenate(sigmas))


def tape_sigmas(observations: Observations) -> Array:
    """Return the standard deviations (2,) of the scales of tape and reference points, 0 without a use."""
    tape, points = observations.tape, observations.points
    reads = any(len(point.distances_m) for point in points)
    refers = reads or any(point.on_reference for point in points)
    return np.array([tape.scale_sigma if reads else _FIXED, tape.references_sigma if refers else _FIXED])


def _free_clocks(observations: Observations) -> NDArray[np.bool_]:
    """Return which cameras have a clock offset to estimate in each recording, (r, c).

    These are the cameras that see moving bodies, but one. The clock of this one is the reference. A camera
    that hardly sees a moving body is no good reference, because it does not determine the times of the paths.
    """
    counts = np.zeros((len(observations.restarts_s) + 1, len(observations.cameras)), dtype=np.intp)
    for camera, sightings in enumerate(observations.sightings):
        moving = sightings.select(sightings.point < 0)
        counts[:, camera] = np.bincount(observations.recording_of(moving), minlength=len(counts))
    free = counts > 0
    free[np.arange(len(free)), (2 * counts >= counts.max(axis=1)[:, None]).argmax(axis=1)] = False
    return free


def _camera_prior(
    camera: CameraPrior, settings: JointSettings, clock_sigma_s: float, moving: bool
) -> tuple[Array, Array]:
    lens = camera.lens
    focal, centre, distortion = (
        (settings.nominal_focal_sigma, settings.nominal_centre_sigma, settings.nominal_distortion_sigma)
        if camera.nominal
        else (settings.focal_sigma, settings.centre_sigma, settings.distortion_sigma)
    )
    f_px, c_px = lens.K.diagonal()[:2], lens.K[:2, 2]
    row_sigma_s = settings.row_time_sigma_s if camera.row_time_s is None and moving else _FIXED
    mean = np.concatenate([np.zeros(6), f_px, c_px, lens.D, np.zeros(3)])
    sigma = np.concatenate(
        [
            np.full(6, np.inf),
            focal * f_px,
            np.full(2, centre * lens.width),
            np.full(len(lens.D), distortion),
            [settings.edge_sigma_px, clock_sigma_s, row_sigma_s],
        ]
    )
    return mean, sigma
