"""Markers with a part hidden by glare or a shadow, compared with ground truth and OpenCV's detector."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import cv2
import numpy as np
import pytest

from ipsys_log.capture.simulation.calibration_points import place_marker
from ipsys_log.capture.simulation.cameras import mount_cameras, prepare_view
from ipsys_log.capture.simulation.drive import plan_drive
from ipsys_log.capture.simulation.render import encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CompressedImage, Event, Marker
from ipsys_log.stages.detect import Detect, search
from ipsys_log.stages.detect.adjustment import Guess, MarkerFit
from ipsys_log.stages.detect.partial import fit_visible_edges
from ipsys_log.stages.detect.search import detect_markers
from ipsys_log.stages.detect.uneven_light import compare_pattern
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.markers import project_corners
from tests.stages.drawing import (
    FISHEYE,
    VGA,
    Array,
    Look,
    Picture,
    Score,
    at_px,
    calibrated,
    corners_px,
    detect,
    draw,
    each_time,
    follow,
    frame,
    jpeg,
    rig,
)
from tests.stages.lighting import LIGHTS, lit_frame, marker_in_glare, spots, streak

DICTIONARY = "DICT_4X4_100"
# Values for the small frames of the fast tests: cells of 13 px at the centre.
SIDE_M = 0.4


def stock(data: bytes) -> list[Marker]:
    return detect_markers(decode_grey(CompressedImage(1, "red", data, "jpeg")), DICTIONARY)


def count_right(markers: Iterable[Marker], truth_px: dict[int, Array]) -> int:
    """Return the number of markers within 10 px of their true position."""
    offs_px = [m.corners_px - truth_px[m.id] for m in markers if m.id in truth_px]
    return sum(bool(np.hypot(*off_px.T).mean() < 10) for off_px in offs_px)


@pytest.mark.parametrize("name", LIGHTS)
def test_edges_in_uneven_light_find_as_many_as_stock(name: str) -> None:
    score, by_stock = Score(), 0
    for seed in range(2):
        data, truth_px = lit_frame(VGA, LIGHTS[name].light, seed, length_m=SIDE_M, count=2)
        score.add(detect(VGA, data), truth_px, truth_px)
        by_stock += count_right(stock(data), truth_px)
    assert score.wrong == []
    assert len(score.offs_px) >= by_stock
    if score.offs_px:
        # Cells are smaller here than at full size, and markers few.
        assert score.rms_px <= 2 * LIGHTS[name].rms_px, score


def test_rest_of_a_large_image_is_searched_in_the_next_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    data, truth_px = lit_frame(VGA, LIGHTS["shadow of 35 %"].light, 0, length_m=SIDE_M, count=2)
    frames = [(time_ns, data) for time_ns in each_time(4)]
    assert [len(markers) for markers in follow(VGA, frames)] == [len(truth_px)] * 4
    monkeypatch.setattr(search, "_MOST_PX", 1)
    counts = [len(markers) for markers in follow(VGA, frames)]
    assert counts[0] < counts[-1] == len(truth_px)


@cache
def scored_at_full_size(name: str) -> tuple[Score, int, list[Array]]:
    """Return the score, the detections of stock, and errors in standard deviations, of 40 markers."""
    score, by_stock, errors = Score(), 0, []
    for seed in range(8):
        data, truth_px = lit_frame(FISHEYE, LIGHTS[name].light, seed + 1000)
        markers = detect(FISHEYE, data)
        score.add(markers, truth_px, truth_px)
        by_stock += count_right(stock(data), truth_px)
        for marker in markers:
            assert marker.covariance_px2 is not None
            sigmas_px = np.sqrt(np.diag(marker.covariance_px2))
            errors.append((marker.corners_px - truth_px[marker.id]).ravel() / sigmas_px)
    return score, by_stock, errors


@pytest.mark.slow
@pytest.mark.parametrize("name", LIGHTS)
def test_edges_in_uneven_light_are_exact_at_full_size(name: str) -> None:
    score, by_stock, _ = scored_at_full_size(name)
    assert score.wrong == []
    assert len(score.offs_px) >= by_stock
    assert score.rms_px <= LIGHTS[name].rms_px, score


@pytest.mark.slow
def test_covariance_with_three_sides_holds_the_errors() -> None:
    """In each coordinate, 68 % of the errors, within 5 points, are below their sigma."""
    errors = [e for name in LIGHTS if "along" in name for e in scored_at_full_size(name)[2]]
    assert np.mean(np.abs(errors) <= 1) == pytest.approx(0.68, abs=0.05)
    assert np.mean(np.abs(errors) <= 2) >= 0.9


# --- the simulator's frames ---------------------------------------------------------------------


def test_simulated_marker_with_glare_on_a_side_is_exact() -> None:
    """Glare is added to the image as saturating light: another method than in the drawing."""
    settings = LabSettings(stations=0, markers=3, width=960, height=540)
    camera = mount_cameras(settings)[0]
    drive = plan_drive(settings, [camera])
    places = [place_marker(one, settings) for one in drive.poses_at(1.0)]
    picture = render(prepare_view(camera, settings), places, settings, np.random.default_rng(0))
    truth_px = {p.id: project_corners(camera.lens, camera.camera_from_world, p) for p in places}
    shown = {n: px for n, px in truth_px.items() if ((px > 20) & (px < [940, 520])).all()}
    assert shown
    levels = picture.astype(np.float64)
    y, x = np.mgrid[: levels.shape[0], : levels.shape[1]]
    for px in shown.values():
        middle, side_px = (px[0] + px[1]) / 2, float(np.linalg.norm(px[1] - px[0]))
        r2 = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
        levels += 110 * np.exp(-r2 / (2 * (0.2 * side_px) ** 2))[..., None]
    data = encode_jpeg(np.clip(np.rint(levels), 0, 255).astype(np.uint8), settings)
    score = Score()
    score.add(detect(camera.lens, data), truth_px, shown)
    assert score.wrong == []
    assert score.missed == []
    assert score.rms_px <= 0.06, score


# --- from frame to frame ------------------------------------------------------------------------


def test_tracked_marker_is_kept_while_glare_moves_over_it() -> None:
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=SIDE_M)
    truth_px = corners_px(VGA, one)
    y, x = np.mgrid[: VGA.height, : VGA.width]
    pictures = [
        draw(
            VGA, [one], Look(glare=300 * np.exp(-((x - column) ** 2 + (y - 205) ** 2) / (2 * 8.0**2)), seed=n)
        )
        for n, column in enumerate(range(240, 430, 12))
    ]
    answers = follow(VGA, zip(each_time(len(pictures)), map(jpeg, pictures), strict=True))
    assert [len(markers) for markers in answers] == [1] * len(pictures)
    for (marker,) in answers:
        assert np.hypot(*(marker.corners_px - truth_px).T).max() < 0.25


# --- detected markers that cannot be measured ----------------------------------------------------


def answers_to(pictures: Iterable[Picture]) -> list[object]:
    stage = Detect("edges")
    messages = [rig(), calibrated(VGA)]
    messages += [frame(jpeg(picture), t) for t, picture in zip(each_time(99), pictures, strict=False)]
    return [payload for message in messages for payload in stage(message)]


def test_marker_that_cannot_be_measured_is_named_once() -> None:
    events = [one for one in answers_to([marker_in_glare()] * 3) if isinstance(one, Event)]
    assert [(one.kind, one.camera, one.marker_id) for one in events] == [("rejected_marker", "red", 5)]
    assert "marker 5 is seen and not measured: glare hides" in events[0].text


def test_even_light_rejects_no_marker() -> None:
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=SIDE_M)
    assert not [e for e in answers_to([draw(VGA, [one], Look())] * 3) if isinstance(e, Event)]


# --- single fits --------------------------------------------------------------------------------


def test_partial_fit_is_never_that_of_another_marker() -> None:
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=SIDE_M)
    glare, _ = streak(300.0, 0.05)(VGA, one, np.random.default_rng(3))
    grey = draw(VGA, [one], Look(glare=glare))
    centre = one.centre_m / SIDE_M
    fits = [fit_visible_edges(grey, [Guess(n, one.axes, centre)], DICTIONARY, VGA) for n in range(5, 100, 3)]
    assert [isinstance(fit, MarkerFit) for fit in fits] == [True] + [False] * (len(fits) - 1)
    noise = np.random.default_rng(0).integers(0, 255, grey.shape).astype(np.uint8)
    for empty in (np.full_like(grey, 150), noise):
        assert fit_visible_edges(empty, [Guess(5, one.axes, centre)], DICTIONARY, VGA) is None


def test_side_in_glare_makes_its_corners_uncertain() -> None:
    """The covariance shows the corners that depend on the other sides only."""
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=SIDE_M, heading_rad=0.0)
    top = corners_px(VGA, one)[:2].mean(axis=0)
    y, _ = np.mgrid[: VGA.height, : VGA.width]
    grey = draw(VGA, [one], Look(glare=400 * np.exp(-((y - top[1]) ** 2) / (2 * 4.0**2))))
    fit = fit_visible_edges(grey, [Guess(5, one.axes, one.centre_m / SIDE_M)], DICTIONARY, VGA)
    assert isinstance(fit, MarkerFit)
    sigmas_px = np.sqrt(np.diag(fit.covariance_px2)).reshape(4, 2)[:, 1]
    assert sigmas_px[:2].min() > 1.15 * sigmas_px[2:].max()
    assert np.abs(fit.corners_px - corners_px(VGA, one)).max() < 0.3


@pytest.mark.parametrize("where", ["edge", "corner", "inside"])
def test_partial_fit_settles_from_some_pixels_aside(where: str) -> None:
    one = at_px(VGA, 5, (330, 240), 2.0, length_m=SIDE_M)
    glare, _ = spots(300.0, 0.08, where)(VGA, one, np.random.default_rng(1))
    grey = draw(VGA, [one], Look(glare=glare))
    aside = np.array([2.0, -2.0, 0.0]) * one.centre_m[2] / SIDE_M / VGA.K[0, 0]
    fit = fit_visible_edges(grey, [Guess(5, one.axes, one.centre_m / SIDE_M + aside)], DICTIONARY, VGA)
    assert isinstance(fit, MarkerFit)
    assert np.hypot(*(fit.corners_px - corners_px(VGA, one)).T).max() < 0.15


def test_pattern_agrees_with_one_marker_in_half_a_shadow() -> None:
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    for marker_id in range(100):
        levels = 30.0 + 0.7 * np.asarray(cv2.aruco.generateImageMarker(known, marker_id, 6), dtype=np.float64)
        levels[:, 3:] *= 0.5
        assert compare_pattern(levels.ravel(), DICTIONARY, marker_id).clear
        assert not compare_pattern(levels.ravel(), DICTIONARY, (marker_id + 1) % 100).likely
        assert not compare_pattern(np.rot90(levels).ravel(), DICTIONARY, marker_id).likely
