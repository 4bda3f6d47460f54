"""Noise of the corners of simulated markers, with the size and the structure that ``detect`` gives.

``detect --corners edges`` fits a square to the edges of a marker. Its corners therefore have a covariance of
rank 6. This module repeats that fit for edges with a known noise. The constants come from a rendered lab with
1848 sightings at 231 calibration points: 20 cm markers in images of 1920 x 1080 px, with the default settings
of the simulator.
"""

import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Array, CameraCalibration
from ipsys_log.vision.markers import marker_corners, pixel_slopes

# Squared errors of rendered corners in units of the stated covariance: the part that is new in each frame,
# and the part that all frames of a stationary marker share.
WHITE_SHARE = 0.8
REPEATABLE_SHARE = 0.35
# Standard deviation of an edge between two cells, for the defaults of the simulator.
_EDGE_SIGMA_PX = 0.0213
_USUAL_NOISE, _USUAL_CONTRAST = 2.0, 170.0
# Error of corners by the point spread, relative to that at 0.7 px (docs/method.md, accuracy).
_PSF_PX = np.array([0.4, 0.7, 1.0, 1.3, 1.6, 2.0])
_PSF_FACTOR = np.array([1.0, 1.0, 1.24, 2.5, 4.1, 5.4])
# A weak prior: squared pixels per squared side, or per squared rad.
_HOLD = 1e-6


def edge_sigma_px(settings: LabSettings) -> float:
    """Return the standard deviation of an edge for the noise, contrast and blur of a lab."""
    contrast = settings.white - settings.black
    noise = settings.noise_sigma / _USUAL_NOISE * _USUAL_CONTRAST / contrast
    # JPEG and interpolation also leave an error in an image without noise.
    noise = float(np.hypot(0.35, noise) / np.hypot(0.35, 1.0))
    return _EDGE_SIGMA_PX * noise * float(np.interp(settings.psf_sigma_px, _PSF_PX, _PSF_FACTOR))


def corner_covariances(
    lens: CameraCalibration, rotations: Array, centres_m: Array, length_m: float, sigma_px: float
) -> Array:
    """Return the covariances of the corners of markers, (n, 8, 8) in px^2 of rank 6.

    Parameters
    ----------
    lens : the camera's true intrinsics.
    rotations, centres_m : (n, 3, 3) and (n, 3), from marker coordinates to camera coordinates.
    length_m : side of the black square.
    sigma_px : from :func:`edge_sigma_px`.
    """
    edges, directions, weights, polarity = _edges()
    by_twist, along_px = _slopes(lens, rotations, centres_m, length_m, edges, directions)
    normals = np.stack([-along_px[..., 1], along_px[..., 0]], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    rows = np.empty((len(rotations), len(edges), 7))
    rows[..., :6] = (normals[..., None, :] @ by_twist)[..., 0, :]
    rows[..., 6] = polarity
    information = (rows * weights[:, None]).swapaxes(1, 2) @ rows + _HOLD * np.eye(7)
    twists = np.linalg.inv(information)[:, :6, :6] * sigma_px**2
    corners = marker_corners(1.0)
    by_corner, _ = _slopes(lens, rotations, centres_m, length_m, corners, np.eye(3)[np.zeros(4, dtype=int)])
    slopes = by_corner.reshape(-1, 8, 6)
    covariances: Array = slopes @ twists @ slopes.swapaxes(1, 2)
    return (covariances + covariances.swapaxes(1, 2)) / 2


def draw_corner_noise(
    covariances_px2: Array, placements: NDArray[np.int64], rng: np.random.Generator, scale: float = 1.0
) -> Array:
    """Draw corner errors (n, 4, 2) in px.

    Parameters
    ----------
    covariances_px2 : (n, 8, 8).
    placements : (n,), numbers of the placements of the markers. Sightings with the same number have the same
        repeatable error. A moving marker has another number in each frame.
    rng : random generator.
    scale : factor of all errors; 0 gives exact corners.
    """
    variances, axes = np.linalg.eigh(covariances_px2)
    roots = axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]
    # The axes of eigenvalues have arbitrary signs, so the repeatable error uses the first sighting's axes.
    _, first, index = np.unique(placements, return_index=True, return_inverse=True)
    kept = (roots[first] @ rng.standard_normal((len(first), 8, 1)))[index.reshape(-1), :, 0]
    new = (roots @ rng.standard_normal((len(roots), 8, 1)))[..., 0]
    noise_px: Array = scale * (np.sqrt(WHITE_SHARE) * new + np.sqrt(REPEATABLE_SHARE) * kept)
    return noise_px.reshape(-1, 4, 2)


def _edges() -> tuple[Array, Array, Array, Array]:
    """Return points on the edges of a marker of 4 x 4 bits and side 1, for any id.

    Returns
    -------
    Points (s, 3), directions (s, 3), number of edges (s,) for which each stands, and polarity (s,).
    """
    across = np.array([-1, 0, 1]) / 3
    outer = [(side, at, 2.0, 1.0) for side in (-0.5, 0.5) for at in across]
    # Half of the 30 inner cell borders are edges on average, with black on either side.
    inner = [
        (side, at, 15 / 4, sign)
        for side, at, sign in ((-0.2, -0.25, 1), (-0.2, 0.25, -1), (0.2, -0.25, -1), (0.2, 0.25, 1))
    ]
    rows = np.array(outer + inner, dtype=np.float64)
    flat = np.zeros(len(rows))
    level = np.stack([rows[:, 1], rows[:, 0], flat], axis=1)
    steep = np.stack([rows[:, 0], rows[:, 1], flat], axis=1)
    directions = np.repeat(np.eye(3)[:2], len(rows), axis=0)
    # The sign of a polarity belongs to an outward normal; all normals here point along +y or -x.
    outward = np.where(np.abs(rows[:, 0]) == 0.5, np.sign(rows[:, 0]), 1.0) * rows[:, 3]
    polarity = np.concatenate([outward, -outward])
    return np.vstack([level, steep]), directions, np.tile(rows[:, 2], 2), polarity


def _slopes(
    lens: CameraCalibration,
    rotations: Array,
    centres_m: Array,
    length_m: float,
    points: Array,
    directions: Array,
) -> tuple[Array, Array]:
    """Return the derivatives of points of markers in the image.

    Returns
    -------
    By a twist of the marker in its own coordinates, in units of its side, (n, s, 2, 6); and along
    ``directions`` (s, 3) of the marker, (n, s, 2); in px per side and px per rad.
    """
    places_m = length_m * (points @ rotations.swapaxes(1, 2)) + centres_m[:, None]
    depth = places_m[..., 2:]
    uv = places_m[..., :2] / depth
    by_uv = pixel_slopes(uv.reshape(-1, 2), lens).reshape(*uv.shape, 2)
    by_point = np.concatenate([by_uv, -(by_uv @ uv[..., None])], axis=-1) / depth[..., None]
    by_marker = length_m * (by_point @ rotations[:, None])
    x, y, z = points.T
    o = np.zeros_like(x)
    turns = np.stack([o, z, -y, -z, o, x, y, -x, o], axis=1).reshape(-1, 3, 3)
    by_twist = np.concatenate([by_marker, by_marker @ turns], axis=-1)
    return by_twist, (by_marker @ directions[:, :, None])[..., 0]
