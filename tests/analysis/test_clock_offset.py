"""Clock offsets of recorders, from markers that both saw moving in a lab without images."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ipsys_log.errors import FitError
from ipsys_log.messages import Markers
from ipsys_log.tools.clock_offset import MarkerPath, estimate_clock_offset
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session

# The exposures of the cameras are out of step, and their stamps say so.
DELAYS_S = (0.0, 0.011, 0.022)


@cache
def paths(seed: int, drive_s: float) -> list[MarkerPath]:
    """Return the paths of all markers in the images of three cameras; three robots stop and go."""
    settings = GeometricSettings(points=3, frame_delays_s=DELAYS_S)
    settings = replace(settings, lab=replace(settings.lab, seed=seed, drive_s=drive_s))
    rows: dict[tuple[str, int], list[tuple[float, ...]]] = {}
    for message in simulate_session(build_lab(settings)):
        if isinstance(message.payload, Markers):
            for marker in message.payload.markers:
                centre_px = marker.corners_px.mean(axis=0).tolist()
                key = str(message.camera), marker.id
                rows.setdefault(key, []).append((message.publish_time_ns / 1e9, *centre_px))
    start_s = min(of_one[0][0] for of_one in rows.values())
    tables = {key: np.array(sorted(of_one)) for key, of_one in rows.items()}
    return [MarkerPath(*key, table[:, 0] - start_s, table[:, 1:]) for key, table in tables.items()]


def split(seed: int, drive_s: float, shift_s: float) -> tuple[list[MarkerPath], list[MarkerPath]]:
    """Return the paths of the first camera, and those of the others with a clock that is ahead."""
    whole = paths(seed, drive_s)
    late = [path._replace(times_s=path.times_s + shift_s) for path in whole if path.camera != "red"]
    return [path for path in whole if path.camera == "red"], late


def test_offset_of_two_clocks_is_found_to_milliseconds() -> None:
    estimate = estimate_clock_offset(*split(3, 20.0, -731.4142))
    assert estimate.offset_s == pytest.approx(731.4142, abs=2e-3)
    assert 0 < estimate.sigma_s < 4e-3
    assert estimate.markers == (0, 1, 2)


def test_markers_that_stand_in_one_recording_give_no_offset() -> None:
    first, second = split(0, 6.0, 0.0)
    standing = [path._replace(centres_px=path.centres_px[:1].repeat(len(path.times_s), 0)) for path in second]
    for recordings in ((first, standing), (standing, first), (first, [])):
        with pytest.raises(FitError, match="no marker moves in the images of both"):
            estimate_clock_offset(*recordings)
    others = [path._replace(marker_id=path.marker_id + 50) for path in second]
    with pytest.raises(FitError, match="no marker moves in the images of both"):
        estimate_clock_offset(first, others)


@pytest.mark.parametrize(
    ("seed", "drive_s", "is_lab"), [(0, 12.0, False), pytest.param(0, 20.0, True, marks=pytest.mark.slow)]
)
def test_paths_of_another_session_do_not_agree(seed: int, drive_s: float, is_lab: bool) -> None:
    """The same ids move in both recordings, but on other paths."""
    first, _ = split(seed, drive_s, 0.0)
    if is_lab:
        _, second = split(seed + 50, drive_s, 0.0)
    else:
        rng = np.random.default_rng(seed)
        times_s = np.arange(0, drive_s, 0.1)
        walk_px = np.cumsum(np.cumsum(rng.normal(size=(3, len(times_s), 2)), axis=1), axis=1)
        second = [MarkerPath("white", marker_id, times_s, walk_px[marker_id]) for marker_id in range(3)]
    with pytest.raises(FitError, match=r"common markers agree at (no offset|several offsets)"):
        estimate_clock_offset(first, second)


def test_path_that_repeats_itself_gives_no_offset() -> None:
    """A robot on a circle at constant speed looks the same after each round."""
    rng = np.random.default_rng(1)
    times_s = np.arange(0, 30.0, 0.05)
    speed = np.clip(np.sin(2 * np.pi * times_s / 3.0), 0, 1)
    angle = np.cumsum(speed) / speed[:60].sum() * 2 * np.pi
    circle_px = 300 * np.column_stack([np.cos(angle), np.sin(angle)]) + 500
    noise_px = rng.normal(scale=0.05, size=(2, *circle_px.shape))
    first = [MarkerPath("red", 1, times_s, circle_px + noise_px[0])]
    second = [MarkerPath("white", 1, times_s, 0.7 * circle_px[:, ::-1] + 90 + noise_px[1])]
    with pytest.raises(FitError, match="agree at several offsets"):
        estimate_clock_offset(first, second)


def with_frames(recording: list[MarkerPath], bits: int) -> list[MarkerPath]:
    """Return the paths in the frames of 0.1 s whose bits are set; live processing skipped the others."""
    frames = [np.floor(path.times_s / 0.1 + 1e-6).astype(int) for path in recording]
    masks = [np.array([bool(bits >> number & 1) for number in of_one.tolist()]) for of_one in frames]
    return [
        path._replace(times_s=path.times_s[mask], centres_px=path.centres_px[mask])
        for path, mask in zip(recording, masks, strict=True)
    ]


# Half of the frames of two cameras, at random. The right offset has the smallest misfit, but its sigma is
# 33 ms. If it is no rival, the estimate is wrong by 1.04 s, with a sigma of 2 ms.
PROCESSED_RED = 0x182CD33796FE6B35C7E9F46882E64DA186A39970000000000000000002B4555ED9F241ACAB8000000007
PROCESSED_WHITE = 0xC190681E1821D3535F9F10DBCC12D501E143344119BAB364468F7546FC74478F09D995E754E00000006C


@pytest.mark.slow
def test_skipped_frames_give_no_wrong_offset() -> None:
    first, second = split(6, 30.0, 0.259)
    second = [path for path in second if path.camera == "white"]
    with pytest.raises(FitError, match=r"agree at (no offset|several offsets)"):
        estimate_clock_offset(with_frames(first, PROCESSED_RED), with_frames(second, PROCESSED_WHITE))


def test_few_common_frames_are_named_as_the_cause() -> None:
    first, second = split(0, 6.0, 0.0)
    every_fifth = sum(1 << frame for frame in range(0, 1000, 5))
    with pytest.raises(FitError, match="too few common instants"):
        estimate_clock_offset(with_frames(first, every_fifth), with_frames(second, every_fifth))


@pytest.mark.slow
def test_errors_of_adjacent_cameras_agree_with_their_sigmas() -> None:
    """Five labs, with short and long drives: docs/log.md has these figures."""
    errors_s, sigmas_s = [], []
    for seed in range(5):
        for drive_s in (12.0, 30.0):
            first, second = split(seed, drive_s, 900.0)
            estimate = estimate_clock_offset(first, [path for path in second if path.camera == "white"])
            errors_s.append(estimate.offset_s + 900.0)
            sigmas_s.append(estimate.sigma_s)
    ratios = np.array(errors_s) / sigmas_s
    assert np.abs(errors_s).max() < 0.004
    assert np.median(sigmas_s) < 0.004
    assert np.sqrt(np.mean(ratios**2)) < 1.5
