"""The simulated lab in real time."""

from __future__ import annotations

import time
from itertools import islice, pairwise

import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CompressedImage, RigCamera
from ipsys_log.sources.frames import Clock, Frame
from ipsys_log.sources.simulated import lab_of, open_simulated, shown_at
from ipsys_log.sources.simulator import LabSettings, hang_cameras, plan_drive
from ipsys_log.sources.simulator.patterns import true_corners
from ipsys_log.sources.simulator.places import place
from ipsys_log.stages.detect import decode_grey, detect_markers
from ipsys_log.units import NS_PER_S

SMALL = {"width": 960, "height": 540, "rate_hz": 20.0}


def take(name: str, count: int, clock: Clock, **other: str) -> list[Frame]:
    camera = RigCamera("red", source=f"sim:{name}", **SMALL, **other)  # type: ignore[arg-type]
    with open_simulated(camera, clock, lambda _: None) as frames:
        return list(islice((frame for frame in frames if frame), count))


def test_frames_come_in_real_time_and_show_the_robots_where_they_are() -> None:
    clock = Clock()
    came = []
    camera = RigCamera("red", source="sim:white?markers=4&seed=2", **SMALL)  # type: ignore[arg-type]
    with open_simulated(camera, clock, lambda _: None) as frames:
        for frame in frames:
            if frame is not None:
                assert frame.time_ns is not None
                came.append((clock.now_ns() - frame.time_ns, frame))
            if len(came) == 60:
                break
    # 60 frames are more than the 40 drawn: some show the drive backwards.
    assert np.median([late_ns for late_ns, _ in came]) < 15e6
    assert min(late_ns for late_ns, _ in came) >= 4e6
    times_ns = [frame.time_ns or 0 for _, frame in came]
    assert np.median([after - before for before, after in pairwise(times_ns)]) == NS_PER_S / 20
    # Where the markers are, from the plan of the drive and the model of the camera.
    settings = LabSettings(**SMALL, markers=4, seed=2)  # type: ignore[arg-type]
    cameras = hang_cameras(settings)
    drive = plan_drive(settings, cameras)
    lens, pose = cameras[1].lens, cameras[1].camera_from_world
    seen = 0
    for time_ns, (_, frame) in list(zip(times_ns, came, strict=True))[::3]:
        since_s = shown_at(round(time_ns * 20 / NS_PER_S), 40) / 20
        grey = decode_grey(CompressedImage(time_ns, "red", frame.data, frame.format))
        for marker in detect_markers(grey, settings.dictionary):
            true_px = true_corners(lens, pose, place(drive.place_at(marker.id, since_s), settings))
            assert np.abs(marker.corners_px - true_px).max() < 1.0
            seen += 1
    assert seen > 10


def test_all_cameras_agree_on_the_time() -> None:
    """The same camera, opened twice by clocks of their own: each instant shows the same."""
    first = {frame.time_ns: frame.data for frame in take("red", 45, Clock())}
    second = {frame.time_ns: frame.data for frame in take("red", 45, Clock())}
    # Two rounds of the loop apart, the frames are the same bytes.
    turn_ns = 78 * NS_PER_S // 20
    by_turn = {(time_ns or 0) % turn_ns: data for time_ns, data in first.items()}
    shared = [(by_turn[t], data) for time, data in second.items() if (t := (time or 0) % turn_ns) in by_turn]
    assert len(shared) > 10
    assert all(one == other for one, other in shared)


def test_a_stamp_is_of_the_instant_that_the_rig_says() -> None:
    clock = Clock()
    frames = {
        stamp: take("red?exposure_s=0.02&row_time_ns=50000&markers=1", 1, clock, stamp=stamp)[0].time_ns
        for stamp in ("start", "end")
    }
    step_ns = NS_PER_S // 20
    assert (frames["start"] or 0) % step_ns == step_ns - 10_000_000
    assert (frames["end"] or 0) % step_ns == 10_000_000 + 539 * 50_000


def test_it_can_be_left_while_it_draws() -> None:
    start = time.monotonic()
    camera = RigCamera("red", source="sim:red", width=1920, height=1080)
    with open_simulated(camera, Clock(), lambda _: None) as frames:
        assert next(frames) is None
    assert time.monotonic() - start < 1


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("sim:green", "has no camera 'green'; write one of sim:red, sim:white, sim:black"),
        ("sim:red?colour=3", "has no setting 'colour'"),
        ("sim:red?seed=three", "seed=three is no number"),
        ("sim:red?markers=0", "simulator setting markers is 0"),
    ],
)
def test_a_lab_that_cannot_be(source: str, said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        lab_of(RigCamera("red", source=source))
