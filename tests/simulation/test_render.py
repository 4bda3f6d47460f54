"""The rendered images, compared with independent formulas."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ipsys_log.capture.simulation.cameras import Camera, FloorView, mount_cameras, prepare_view
from ipsys_log.capture.simulation.render import encode_jpeg, expose, render
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.vision.markers import PlacedMarker, project_corners
from ipsys_log.vision.poses import make_pose, pose_facing_up, rotation

Array = NDArray[np.float64]
LENGTH_M = 0.2
SETTINGS = LabSettings()


@pytest.fixture(scope="module")
def views() -> list[FloorView]:
    return [prepare_view(camera, SETTINGS) for camera in mount_cameras(SETTINGS)]


def lay(marker_id: int, x_m: float, y_m: float, z_m: float, heading_rad: float) -> PlacedMarker:
    return PlacedMarker(marker_id, LENGTH_M, pose_facing_up(x_m, y_m, z_m, heading_rad))


def world_points(x_m: float, y_m: float, z_m: float, heading_rad: float, local: Array) -> Array:
    """Return world points of a print (along its right side, along its top side) on the floor."""
    up = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    right = np.array([np.sin(heading_rad), -np.cos(heading_rad)])
    xy = np.array([x_m, y_m]) + local[:, :1] * right + local[:, 1:] * up
    return np.column_stack([xy, np.full(len(xy), z_m)])


def to_pixels(camera: Camera, points_m: Array) -> Array:
    """Project with the formula of Kannala and Brandt."""
    x, y, z = (points_m @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]).T
    r = np.hypot(x, y)
    theta = np.arctan2(r, z)
    k1, k2, k3, k4 = camera.lens.D
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    K = camera.lens.K
    return np.column_stack([K[0, 0] * bent * x / r + K[0, 2], K[1, 1] * bent * y / r + K[1, 2]])


CORNERS = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]) * LENGTH_M / 2


def test_true_corners_agree_with_the_formulas(views: list[FloorView]) -> None:
    rng = np.random.default_rng(1)
    for view in views:
        for _ in range(10):
            x, y, z, turn = rng.uniform([0, 0, 0, -3], [4.8, 4.8, 0.2, 3])
            found = project_corners(view.camera.lens, view.camera.camera_from_world, lay(0, x, y, z, turn))
            wanted = to_pixels(view.camera, world_points(x, y, z, turn, CORNERS))
            np.testing.assert_allclose(found, wanted, atol=1e-8)


def edge_errors(view: FloorView, placed: PlacedMarker, settings: LabSettings) -> Array:
    """Return the errors in px of the drawn sides of the black square, by pixel row.

    The sum of the light along a line across an edge gives the position of the edge, for any blur.
    """
    image = expose(view, [placed], settings).astype(np.float64)
    camera_from_marker = view.camera.camera_from_world @ placed.world_from_marker
    vector = cv2.Rodrigues(camera_from_marker[:3, :3])[0]
    half = placed.length_m / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    errors: list[float] = []
    for start, stop in zip(square, np.roll(square, -1, axis=0), strict=True):
        side = start + np.linspace(0.2, 0.8, 400)[:, None] * (stop - start)
        px = cv2.fisheye.projectPoints(
            side[:, None], vector, camera_from_marker[:3, 3].copy(), view.camera.lens.K, view.camera.lens.D
        )[0].reshape(-1, 2)
        across = 0 if np.ptp(px[:, 1]) > np.ptp(px[:, 0]) else 1
        lines = image if across == 0 else image.T
        px = px[np.argsort(px[:, 1 - across])]
        for line in range(int(np.ceil(px[0, 1 - across])), int(px[-1, 1 - across]) + 1):
            edge = float(np.interp(line, px[:, 1 - across], px[:, across]))
            middle = round(edge)
            if not (0 <= line < len(lines) and 4 <= middle < lines.shape[1] - 4):
                continue
            window = lines[line, middle - 4 : middle + 5]
            bright = (window - settings.black).sum() / (settings.white - settings.black)
            rising = window[0] < window[-1]
            errors.append(middle + 4.5 - bright - edge if rising else edge - (middle - 4.5 + bright))
    return np.array(errors)


@pytest.mark.parametrize("turn_rad", [0.0, np.pi / 2, 0.3, 2.0])
def test_rendered_edges_are_exact_to_0_01_px(views: list[FloorView], turn_rad: float) -> None:
    rng = np.random.default_rng(int(turn_rad * 10))
    for view in views:
        y_m = view.camera.origin_m[1]
        for _ in range(3):
            x, y, z = rng.uniform([0.8, y_m - 0.6, 0.0], [4.1, y_m + 0.6, 0.2]).tolist()
            errors = edge_errors(view, lay(3, x, y, z, turn_rad), SETTINGS)
            assert len(errors) > 50
            assert np.abs(errors).max() < 0.01
            assert np.sqrt(np.mean(errors**2)) < 0.005
            assert abs(errors.mean()) < 0.001


def test_edges_of_a_tilted_marker_are_as_exact(views: list[FloorView]) -> None:
    tilted = pose_facing_up(3.0, 2.6, 0.1, 0.7) @ make_pose(
        rotation(np.array([0.12, -0.05, 0.0])), np.zeros(3)
    )
    errors = edge_errors(views[1], PlacedMarker(5, LENGTH_M, tilted), SETTINGS)
    assert np.abs(errors).max() < 0.01


# Draws each pixel from 144 samples.
@pytest.mark.slow
def test_a_frame_equals_one_drawn_by_brute_force(views: list[FloorView]) -> None:
    """Render twelve by twelve samples per pixel through a numerical inverse of the lens."""
    view, samples = views[1], 12
    where = (3.1, 2.9, 0.15, 0.6)
    corners = project_corners(view.camera.lens, view.camera.camera_from_world, lay(7, *where))
    low = corners.min(axis=0).astype(int) - 2
    size = np.ptp(corners, axis=0).astype(int) + 5
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    x = (low[0] + np.arange(-8, size[0] + 8)[:, None] + steps).ravel()
    y = (low[1] + np.arange(-8, size[1] + 8)[:, None] + steps).ravel()
    local = local_points(view.camera, *where, np.stack(np.meshgrid(x, y), axis=-1))
    drawn = hard_print(local, 7)
    drawn = gaussian_filter(drawn, SETTINGS.psf_sigma_px * samples, truncate=6)
    drawn = drawn.reshape(size[1] + 16, samples, size[0] + 16, samples).mean(axis=(1, 3))[8:-8, 8:-8]
    fast = expose(view, [lay(7, *where)], SETTINGS)
    fast = fast[low[1] : low[1] + size[1], low[0] : low[0] + size[0]]
    # The reference does not draw the floor: compare only pixels away from the edge of the print.
    inner = np.zeros(fast.shape, np.uint8)
    cv2.fillConvexPoly(inner, np.round(corners - low).astype(np.int32), 1)
    off = (fast - drawn)[inner > 0]
    assert np.abs(off).max() < 1.0
    assert np.sqrt(np.mean(off**2)) < 0.2


def local_points(camera: Camera, x: float, y: float, z: float, turn: float, px: Array) -> Array:
    """Return pixels on the plane of a print, along its right and top side."""
    K, D = camera.lens.K, camera.lens.D
    mx, my = (px[..., 0] - K[0, 2]) / K[0, 0], (px[..., 1] - K[1, 2]) / K[1, 1]
    bent = np.hypot(mx, my)
    below, above = np.zeros_like(bent), np.full_like(bent, 1.4)
    for _ in range(32):
        theta = (below + above) / 2
        t2 = theta**2
        high = theta * (1 + t2 * (D[0] + t2 * (D[1] + t2 * (D[2] + t2 * D[3])))) > bent
        above, below = np.where(high, theta, above), np.where(high, below, theta)
    ray = np.stack([np.sin(theta) * mx / bent, np.sin(theta) * my / bent, np.cos(theta)], axis=-1)
    ray = ray @ camera.camera_from_world[:3, :3]
    hit = camera.origin_m[:2] + ray[..., :2] * ((z - camera.origin_m[2]) / ray[..., 2])[..., None]
    off = hit - [x, y]
    right, up = np.array([np.sin(turn), -np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])
    return np.stack([off @ right, off @ up], axis=-1)


def hard_print(local: Array, marker_id: int) -> Array:
    """Return black or white at points of a print."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    cells = np.asarray(cv2.aruco.generateImageMarker(known, marker_id, 6))
    column = np.floor((local[..., 0] / LENGTH_M + 0.5) * 6).astype(int)
    row = np.floor((0.5 - local[..., 1] / LENGTH_M) * 6).astype(int)
    inside = (column >= 0) & (column < 6) & (row >= 0) & (row < 6)
    black = inside & (cells[np.clip(row, 0, 5), np.clip(column, 0, 5)] == 0)
    return np.where(black, SETTINGS.black, SETTINGS.white)


def test_gamma_keeps_black_and_white_and_thins_black(views: list[FloorView]) -> None:
    settings = replace(SETTINGS, gamma=2.2)
    view = prepare_view(views[1].camera, settings)
    placed = lay(3, 2.6, 2.3, 0.0, 0.2)
    image = expose(view, [placed], settings)
    corners = project_corners(view.camera.lens, view.camera.camera_from_world, placed)
    outer = image[int(corners[:, 1].min()) : int(corners[:, 1].max())]
    assert outer.min() == pytest.approx(35, abs=0.05)
    assert image.max() == pytest.approx(205, abs=0.05)
    # Blurred light, then gamma: about 0.2 to 0.4 px of black are lost on each side.
    assert -0.5 < edge_errors(view, placed, settings).mean() < -0.1


def test_unblurred_pixels_are_black_white_or_mixed_at_edges(views: list[FloorView]) -> None:
    settings = replace(SETTINGS, psf_sigma_px=0.0)
    view = prepare_view(views[1].camera, settings)
    image = expose(view, [lay(3, 2.6, 2.3, 0.0, 0.0)], settings)
    assert image.min() == pytest.approx(35, abs=1e-3)
    assert np.abs(edge_errors(view, lay(3, 2.6, 2.3, 0.0, 0.0), settings)).max() < 0.02


def test_the_stock_detector_finds_every_marker_near_its_truth(views: list[FloorView]) -> None:
    rng = np.random.default_rng(5)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100))
    errors = []
    for view in views:
        y_m = view.camera.origin_m[1]
        placed = [lay(n, 0.7 + 0.85 * n, y_m + (-0.5 if n % 2 else 0.4), 0.05 * n, n) for n in range(5)]
        data = encode_jpeg(render(view, placed, SETTINGS, rng), SETTINGS)
        image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE))
        corners, ids, _ = detector.detectMarkers(image)
        assert sorted(np.ravel(ids).tolist()) == [0, 1, 2, 3, 4]
        for found, marker_id in zip(corners, np.ravel(ids).tolist(), strict=True):
            start = np.ascontiguousarray(found, np.float32).reshape(-1, 1, 2)
            fine = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), (3, 40, 0.001)).reshape(4, 2)
            truth = project_corners(view.camera.lens, view.camera.camera_from_world, placed[int(marker_id)])
            errors.append(fine - truth)
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=-1))) < 0.35


def test_marker_at_the_image_edge_is_cut_off(views: list[FloorView]) -> None:
    view = views[1]
    bare = expose(view, [], SETTINGS)
    cut = expose(view, [lay(1, 2.44, view.camera.origin_m[1] + 1.0, 0.0, 0.4)], SETTINGS)
    changed = np.abs(cut - bare) > 0
    rows = np.flatnonzero(changed.any(axis=1))
    assert rows[0] == 0
    assert rows[-1] < 200
    assert (expose(view, [lay(1, 2.44, -3.0, 0.0, 0.4)], SETTINGS) == bare).all()


def test_a_marker_is_not_seen_from_behind(views: list[FloorView]) -> None:
    turned = pose_facing_up(2.44, 2.44, 0.1, 0.0) @ make_pose(
        rotation(np.array([np.pi, 0.0, 0.0])), np.zeros(3)
    )
    bare = expose(views[1], [], SETTINGS)
    assert (expose(views[1], [PlacedMarker(1, LENGTH_M, turned)], SETTINGS) == bare).all()


def test_noise_has_the_stated_sigma_and_is_new_in_each_frame(views: list[FloorView]) -> None:
    rng = np.random.default_rng(0)
    still = expose(views[1], [], SETTINGS)
    first, second = (render(views[1], [], SETTINGS, rng)[..., 1] - still for _ in range(2))
    # Rounding to whole grey levels adds 1/12.
    assert first.std() == pytest.approx(np.sqrt(SETTINGS.noise_sigma**2 + 1 / 12), abs=0.02)
    assert first.mean() == pytest.approx(0.0, abs=0.02)
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] == pytest.approx(0.0, abs=0.005)
