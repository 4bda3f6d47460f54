"""Corners from edges, compared with ground truth of the simulator and of independent drawings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from ipsys_log.capture.simulation.calibration_points import SimulatedPose, cameras_seeing, place_marker
from ipsys_log.capture.simulation.cameras import Camera, FloorView, mount_cameras, prepare_view
from ipsys_log.capture.simulation.drive import plan_drive
from ipsys_log.capture.simulation.lab import EPOCH_NS, simulate, start_of_set_ns
from ipsys_log.capture.simulation.render import encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.capture.simulation.textured_floor import feet
from ipsys_log.messages import CameraCalibration, CompressedImage, Marker, RigCamera, Tracks
from ipsys_log.stages.detect.adjustment import Guess
from ipsys_log.stages.detect.edges import fit_edges
from ipsys_log.stages.detect.follow import MarkerTracker
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.markers import project_corners
from tests.stages.drawing import (
    FISHEYE,
    PLUMB_BOB,
    RATIONAL,
    VGA,
    Array,
    Look,
    Picture,
    Print,
    Score,
    at_px,
    corners_px,
    detect,
    draw,
    facing,
    follow,
    jpeg,
    strewn,
    texture,
    tiles,
    vignette,
)

LAB = LabSettings(stations=0)
CAMERAS = dict(zip(LAB.cameras, mount_cameras(LAB), strict=True))


# --- the simulator's frames ---------------------------------------------------------------------


@cache
def view(camera: str, gamma: float) -> FloorView:
    return prepare_view(CAMERAS[camera], replace(LAB, gamma=gamma))


def filmed(settings: LabSettings, camera: str, starts_s: Sequence[float], frames: int) -> Score:
    """Return consecutive frames of one camera at 30 Hz, from each of some times of the drive."""
    score, rng = Score(), np.random.default_rng(0)
    drive, where = plan_drive(settings, list(CAMERAS.values())), CAMERAS[camera]
    for start_s in starts_s:
        seen, truths, wholes = [], [], []
        for time_s in start_s + np.arange(frames) / 30:
            places = drive.poses_at(time_s)
            prints = [place_marker(one, settings) for one in places]
            data = encode_jpeg(render(view(camera, settings.gamma), prints, settings, rng), settings)
            seen.append((EPOCH_NS + round(time_s * NS_PER_S), data))
            truths.append({p.id: project_corners(where.lens, where.camera_from_world, p) for p in prints})
            wholes.append([one.marker_id for one in places if cameras_seeing(one, [where], settings)])
        for markers, truth_px, whole in zip(follow(where.lens, seen), truths, wholes, strict=True):
            score.add(markers, truth_px, whole)
    return score


def check(score: Score, rms_px: float, max_px: float, found: float) -> None:
    assert score.wrong == [], score
    assert score.rms_px <= rms_px, score
    assert score.max_px <= max_px, score
    assert score.found >= found, score


def test_corners_along_a_drive() -> None:
    check(filmed(replace(LAB, markers=1), "red", [0.0], 4), 0.06, 0.5, 0.995)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "camera"), [(1, "white"), (3, "red"), (8, "black")])
def test_corners_along_the_whole_drive(count: int, camera: str) -> None:
    starts_s = np.arange(0, 15, 1.5).tolist()
    check(filmed(replace(LAB, markers=count), camera, starts_s, 10), 0.06, 0.5, 0.995)


@pytest.mark.parametrize(
    "starts_s", [(2.0,), pytest.param(np.arange(0, 15, 3.0).tolist(), marks=pytest.mark.slow)]
)
def test_a_gamma_does_not_move_corners(starts_s: Sequence[float]) -> None:
    """Gamma makes black too small by the same distance for all markers: the offset corrects this."""
    score = filmed(replace(LAB, markers=8, gamma=2.2), "black", starts_s, 3)
    check(score, 0.07, 0.5, 0.995)
    assert np.mean(score.edge_offsets_px) == pytest.approx(0.42, abs=0.05)
    assert np.std(score.edge_offsets_px) < 0.05


@pytest.mark.parametrize("dictionary", ["DICT_4X4_100", "DICT_APRILTAG_36h11"])
def test_textured_floor_loses_no_marker(dictionary: str) -> None:
    """Small markers between clutter: a first frame shows those that OpenCV detects, and no other ids."""
    lab = replace(LAB, textured=True, markers=12, marker_length_m=0.05, dictionary=dictionary)
    camera, score = CAMERAS["white"], Score()
    drive, floor = plan_drive(lab, list(CAMERAS.values())), prepare_view(camera, lab)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))
    for time_s in (1.0, 4.0, 9.0):
        places = drive.poses_at(time_s)
        prints = [place_marker(one, lab) for one in places]
        data = encode_jpeg(render(floor, [*feet(lab, time_s), *prints], lab, None), lab)
        truth_px = {p.id: project_corners(camera.lens, camera.camera_from_world, p) for p in prints}
        image = CompressedImage(1, camera.name, data, "jpeg")
        px, ids, _ = detector.detectMarkers(decode_grey(image))
        numbers = [int(n) for n in np.ravel(ids)]
        stock = [
            n
            for n, corners in zip(numbers, px, strict=True)
            if n in truth_px and np.abs(corners[0] - truth_px[n]).max() < 10
        ]
        track = MarkerTracker(dictionary, camera.lens, None, 0.0, ids=frozenset(truth_px))
        fits, _, _ = track(image, 1)
        score.add([Marker(fit.pose.id, fit.corners_px) for fit in fits], truth_px, stock)
    assert len(score.offs_px) > 8
    check(score, 0.15, 0.5, 1.0)


ROLLING = LabSettings(
    stations=0, markers=3, drive_s=1.2, drive_speed_m_s=2.0, row_time_ns=31_000, exposure_s=1 / 60
)


@pytest.mark.slow
def test_rolling_shutter_markers_are_at_their_exposure_position() -> None:
    """Robots have 2 m/s and 1/60 s of motion blur; the speed is known from the third sighting."""
    cameras = mount_cameras(ROLLING)
    drive, start_ns = plan_drive(ROLLING, cameras), start_of_set_ns(ROLLING, 0)
    row_s = ROLLING.row_time_ns / NS_PER_S
    following = {c.name: MarkerTracker(ROLLING.dictionary, c.lens, None, row_s) for c in cameras}
    times_seen: Counter[tuple[str, int]] = Counter()
    whole: dict[int, tuple[str, ...]] = {}
    to_find: list[bool] = []
    offs_m = []
    for message in simulate(ROLLING):
        if isinstance(message.payload, Tracks):
            whole = {track.id: track.cameras for track in message.payload.tracks}
        if not isinstance(message.payload, CompressedImage):
            continue
        (camera,) = (one for one in cameras if one.name == message.camera)
        fits, _, _ = following[camera.name](message.payload, message.publish_time_ns)
        seen = {fit.pose.id: fit for fit in fits}
        to_find += [marker_id in seen for marker_id, names in whole.items() if camera.name in names]
        for marker_id in whole:
            key = camera.name, marker_id
            times_seen[key] = times_seen[key] + 1 if marker_id in seen else 0
            if times_seen[key] >= 3:
                fit = seen[marker_id]
                late_s = float(fit.corners_px[:, 1].mean()) * row_s
                time_s = (message.publish_time_ns - start_ns) / NS_PER_S + late_s
                truth_m = centre_m(camera, drive.pose_at(marker_id, time_s))
                offs_m.append(fit.pose.centre * ROLLING.marker_length_m - truth_m)
    rms_m = float(np.sqrt(np.mean(np.sum(np.square(offs_m), axis=1))))
    assert len(offs_m) > 50
    assert np.mean(to_find) >= 0.95
    assert rms_m <= 0.0015


def centre_m(camera: Camera, where: SimulatedPose) -> Array:
    return (camera.camera_from_world @ [where.x_m, where.y_m, where.z_m, 1.0])[:3]


# --- frames drawn by other code -----------------------------------------------------------------


def strew(
    lens: CameraCalibration,
    look: Look,
    frames: int,
    per_frame: int,
    quality: int = 90,
    change: Callable[[Print, np.random.Generator], Print] = lambda one, rng: one,
    first: int = 0,
    **where: Any,
) -> Score:
    """Return markers at random positions, each frame independently."""
    score = Score()
    for n in range(first, first + frames):
        rng = np.random.default_rng(n)
        prints = [change(one, rng) for one in strewn(lens, per_frame, rng, look, **where)]
        data = jpeg(draw(lens, prints, replace(look, seed=n)), quality)
        score.add(
            detect(lens, data, look),
            {one.id: corners_px(lens, one) for one in prints},
            range(per_frame),
        )
    return score


PLAIN = Look()


@dataclass(frozen=True)
class Row:
    """A scene, and its expected result."""

    rms_px: float
    found: float = 0.98
    max_px: float = 0.5
    lens: CameraCalibration = FISHEYE
    look: Look = PLAIN
    quality: int = 90
    length_m: float = 0.2
    per_frame: int = 5
    change: Callable[[Print, np.random.Generator], Print] = lambda one, rng: one


def cover(level: float) -> Callable[[Print, np.random.Generator], Print]:
    """One inner cell is covered."""

    def covered(one: Print, rng: np.random.Generator) -> Print:
        return one._replace(covered={(int(rng.integers(1, 5)), int(rng.integers(1, 5))): level})

    return covered


def cells_px(size_px: float, cells: int = 6) -> float:
    """Return the length in m of a marker with a given cell size in px at the image centre."""
    return size_px * cells * 2.0 / float(FISHEYE.K[0, 0])


ROWS: dict[str, Row] = {
    "plain": Row(0.06),
    "gamma 2.2": Row(0.07, 0.96, look=Look(gamma=2.2)),
    "textured floor": Row(0.06, look=Look(floor=texture(FISHEYE, 1))),
    "tiled floor": Row(0.06, 0.95, look=Look(floor=tiles(FISHEYE))),
    "vignetting and a gradient": Row(0.06, look=Look(shade=vignette(FISHEYE))),
    "half a margin": Row(0.06, look=Look(margin_cells=0.5)),
    "half a margin on a dark floor": Row(0.10, 0.88, look=Look(margin_cells=0.5, floor=60)),
    "low contrast": Row(0.08, look=Look(black=60, white=110, floor=90)),
    "noise 6": Row(0.08, look=Look(noise=6.0)),
    "quality 70": Row(0.06, quality=70),
    "overexposed": Row(0.06, look=Look(black=60, white=255, floor=240)),
    "blur 0.4 px": Row(0.06, look=Look(psf_px=0.4)),
    "blur 1.0 px": Row(0.1, look=Look(psf_px=1.0)),
    "blur 1.6 px": Row(0.25, max_px=1.0, look=Look(psf_px=1.6)),
    "plumb_bob": Row(0.06, lens=PLUMB_BOB),
    "rational_polynomial": Row(0.06, lens=RATIONAL),
    "5X5": Row(0.06, look=Look(dictionary="DICT_5X5_50")),
    "AprilTag 36h11": Row(0.06, look=Look(dictionary="DICT_APRILTAG_36h11")),
    "640 x 480": Row(0.12, 0.85, 1.0, lens=VGA),
    "cells of 5 px": Row(0.1, 0.7, length_m=cells_px(5)),
    "cells of 8 px": Row(0.1, 0.85, length_m=cells_px(8)),
    "cells of 20 px": Row(0.06, length_m=cells_px(20), per_frame=3),
    "cells of 40 px": Row(0.06, length_m=cells_px(40), per_frame=1),
    "a cell covered": Row(0.06, 0.95, change=cover(130.0)),
    "a cell in glare": Row(0.06, 0.9, change=cover(255.0)),
}


def scored(row: Row, frames: int, per_frame: int) -> Score:
    return strew(row.lens, row.look, frames, per_frame, row.quality, row.change, length_m=row.length_m)


@pytest.mark.parametrize("name", [*ROWS][:10])
def test_corners_of_another_renderer(name: str) -> None:
    # One frame gives less information than many.
    row = ROWS[name]
    check(scored(row, 1, row.per_frame), 1.5 * row.rms_px, row.max_px, 0.6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_corners_of_another_renderer_over_many_frames(name: str) -> None:
    row = ROWS[name]
    check(scored(row, 12, row.per_frame), row.rms_px, row.max_px, row.found)


@pytest.mark.slow
def test_random_poses_out_to_the_edge_of_the_image() -> None:
    check(strew(FISHEYE, Look(), 60, 8), 0.06, 0.5, 0.98)


def test_marker_in_shadow_is_found_within_a_second() -> None:
    """The paper is darker than the floor, so that only the thorough search finds the marker."""
    look = Look(black=20, white=80, floor=150)
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=0.4)
    empty, data = jpeg(draw(VGA, [], look)), jpeg(draw(VGA, [one], look))
    assert [marker.id for marker in detect(VGA, data, look)] == [5]
    # The first frame is searched thoroughly. Here the marker appears in the second frame.
    frames = [(n * 33_000_000, data if n else empty) for n in range(30)]
    answers = follow(VGA, frames, look)
    assert [marker.id for marker in answers[-1]] == [5]
    assert np.hypot(*(answers[-1][0].corners_px - corners_px(VGA, one)).T).max() < 0.15
    # Cameras do so in turn: at the same time, it would take longer than live tracking allows.
    others = [RigCamera(name) for name in ("black", "red")]
    rigs = [(RigCamera(VGA.frame_id), *others), (*others, RigCamera(VGA.frame_id))]
    first, last = ([*map(bool, follow(VGA, frames, look, *them))] for them in rigs)
    assert 0 < first.index(True) < last.index(True) < 30


def test_glare_on_a_marker_gives_no_wrong_one() -> None:
    """With too much glare, the marker is not found. It is never found at a wrong position."""
    y, x = np.mgrid[: VGA.height, : VGA.width]
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=0.4)
    for strength in (60, 120, 250):
        glare = strength * np.exp(-((x - 310) ** 2 + (y - 225) ** 2) / (2 * 12.0**2))
        markers = detect(VGA, jpeg(draw(VGA, [one], Look(glare=glare))))
        assert {marker.id for marker in markers} <= {5}
        for marker in markers:
            assert np.hypot(*(marker.corners_px - corners_px(VGA, one)).T).max() < 0.6


# --- covariance ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("look", "frames"),
    [
        (Look(), 50),
        (Look(noise=6.0), 30),
        (Look(black=60, white=110, floor=90), 30),
    ],
)
def test_corner_covariance_is_consistent(look: Look, frames: int) -> None:
    score = strew(FISHEYE, look, frames, 6)
    assert 0.7 < np.mean(score.normalized) < 1.9, score


def test_covariance_of_blurred_corners_is_consistent() -> None:
    assert np.mean(strew(FISHEYE, Look(psf_px=1.6), 1, 5).normalized) < 3


def test_a_covariance_is_one_of_a_rigid_square() -> None:
    """The covariance has eight coordinates and rank six; it is symmetric and never negative."""
    (marker, *_) = detect(FISHEYE, jpeg(draw(FISHEYE, [at_px(FISHEYE, 3, (700, 500))], Look())))
    assert marker.covariance_px2 is not None
    np.testing.assert_allclose(marker.covariance_px2, marker.covariance_px2.T, atol=1e-9)
    values = np.linalg.eigvalsh(marker.covariance_px2)
    assert (values[2:] > 1e-9).all()
    assert np.abs(values[:2]).max() < 1e-3 * values[-1]
    np.testing.assert_array_equal(marker.covariance_px2, marker.covariance_px2.astype(np.float32))


# --- edge offset --------------------------------------------------------------------------------


def one_marker(look: Look, *cameras: RigCamera) -> tuple[Marker, Array]:
    one = at_px(FISHEYE, 3, (700, 500))
    (marker,) = detect(FISHEYE, jpeg(draw(FISHEYE, [one], look)), look, *cameras)
    return marker, marker.corners_px - corners_px(FISHEYE, one)


def test_an_edge_offset_that_is_given_is_used() -> None:
    marker, right_px = one_marker(Look(gamma=2.2), RigCamera("red", edge_offset_px=0.42))
    assert marker.edge_offset_px == pytest.approx(0.42, abs=1e-4)
    assert np.abs(right_px).max() < 0.06
    # For an image without gamma, the offset is wrong: black is assumed too large all around.
    marker, wrong_px = one_marker(Look(), RigCamera("red", edge_offset_px=0.36))
    assert marker.edge_offset_px == pytest.approx(0.36, abs=1e-4)
    assert 0.3 < np.hypot(*wrong_px.T).mean() < 0.6
    assert np.abs(wrong_px.mean(axis=0)).max() < 0.05
    # The offset belongs to that camera only.
    marker, other_px = one_marker(Look(), RigCamera("white", edge_offset_px=0.36))
    assert marker.edge_offset_px == pytest.approx(0.0, abs=0.02)
    assert np.abs(other_px).max() < 0.06


# --- single fits --------------------------------------------------------------------------------


@cache
def still() -> tuple[Picture, Print]:
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=0.4)
    return draw(VGA, [one], Look()), one


def guess(one: Print, shift_px: tuple[float, float] = (0.0, 0.0), marker_id: int | None = None) -> Guess:
    """Return a marker's pose in sides of the marker, beside its true position."""
    z = one.centre_m[2] / one.length_m
    shift = np.array([*shift_px, 0.0]) * z / VGA.K[0, 0]
    return Guess(one.id if marker_id is None else marker_id, one.axes, one.centre_m / one.length_m + shift)


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (4.0, -3.0), (-5.0, 0.0), (3.0, 5.0)])
def test_fit_recovers_the_parameters(shift_px: tuple[float, float]) -> None:
    grey, one = still()
    (fit,) = fit_edges(grey, [guess(one, shift_px)], "DICT_4X4_100", VGA)
    assert fit is not None
    assert np.hypot(*(fit.corners_px - corners_px(VGA, one)).T).max() < 0.1
    np.testing.assert_allclose(fit.pose.centre * one.length_m, one.centre_m, atol=0.004)


def test_other_markers_are_not_fitted() -> None:
    grey, one = still()
    empty = np.full_like(grey, 150)
    noise = np.random.default_rng(0).integers(0, 255, grey.shape).astype(np.uint8)
    wrong_ids = [n for n in range(100) if n != one.id]
    found = fit_edges(grey, [guess(one, marker_id=n) for n in wrong_ids], "DICT_4X4_100", VGA)
    assert found == [None] * 99
    assert fit_edges(empty, [guess(one)], "DICT_4X4_100", VGA) == [None]
    assert fit_edges(noise, [guess(one)], "DICT_4X4_100", VGA) == [None]
    assert fit_edges(grey, [guess(one, (60.0, 0.0))], "DICT_4X4_100", VGA) == [None]
    assert fit_edges(grey, [], "DICT_4X4_100", VGA) == []


def test_fits_do_not_disturb_one_another() -> None:
    """Markers are fitted together; a false marker does not change the others."""
    grey, one = still()
    (alone,) = fit_edges(grey, [guess(one)], "DICT_4X4_100", VGA)
    together = fit_edges(
        grey, [guess(one, (90, 40)), guess(one), guess(one, marker_id=9)], "DICT_4X4_100", VGA
    )
    assert alone is not None
    assert [fit is not None for fit in together] == [False, True, False]
    assert together[1] is not None
    np.testing.assert_allclose(together[1].corners_px, alone.corners_px, atol=0.03)


def test_a_marker_beyond_the_edge_is_not_fitted() -> None:
    """A corner outside the image was not seen, even if the rest fits well."""
    one = at_px(VGA, 5, (9, 240), 2.0, length_m=0.4)
    grey = draw(VGA, [one], Look())
    assert (corners_px(VGA, one) < 0).any()
    assert fit_edges(grey, [guess(one)], "DICT_4X4_100", VGA) == [None]


@pytest.mark.parametrize("tilt_deg", [15, 30, 45])
def test_a_tilted_marker_follows_its_tilt(tilt_deg: float) -> None:
    """The start is the correct one of the two similar poses."""
    axes = facing(0.4, np.radians(tilt_deg) * np.array([0.6, 0.8, 0.0]))
    one = Print(5, axes, np.array([0.2, 0.1, 1.2]), 0.4)
    (fit,) = fit_edges(draw(VGA, [one], Look()), [guess(one)], "DICT_4X4_100", VGA)
    assert fit is not None
    assert np.hypot(*(fit.corners_px - corners_px(VGA, one)).T).max() < 0.15
    angle_rad = np.arccos(np.clip((np.trace(fit.pose.rotation.T @ axes) - 1) / 2, -1, 1))
    assert np.degrees(angle_rad) < 1.5


def test_tilted_marker_is_fitted_with_its_tilt() -> None:
    score = strew(FISHEYE, Look(), 3, 6, first=100, tilt_deg=50.0)
    assert score.max_px < 0.5, score
