"""The simulated lab in real time."""

import math
import threading
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.calibration.board import parse_board
from ipsys_log.calibration.calibrate import CalibrationResult, calibrate_cameras
from ipsys_log.calibration.images import find_sources
from ipsys_log.calibration.lens_models import find_lens_model
from ipsys_log.capture import simulated
from ipsys_log.capture.frames import Clock, Frame
from ipsys_log.capture.simulated import open_simulated, parse_source
from ipsys_log.capture.simulation.calibration_points import place_marker
from ipsys_log.capture.simulation.cameras import mount_cameras, prepare_view
from ipsys_log.capture.simulation.live_lab import POSES, board_film, image_index, lab_film, plan_live_lab
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CompressedImage, RigCamera
from ipsys_log.stages.detect.search import detect_markers
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.markers import project_corners
from tests.playing import WAIT_LIMIT_S

SMALL = {"width": 960, "height": 540, "rate_hz": 20.0}
# The images are in one direction; shown back and forth, they repeat after 38 frames.
BRIEF, TURN = "drive_s=1&stations=6", 38


def take(name: str, count: int, clock: Clock, **other: str) -> list[Frame]:
    camera = RigCamera("red", source=f"sim:{name}", **SMALL, **other)  # type: ignore[arg-type]
    with open_simulated(camera, clock, lambda _: None) as frames:
        return list(islice((frame for frame in frames if frame), count))


@pytest.mark.slow
def test_frames_show_each_marker_where_it_is() -> None:
    clock = Clock()
    source = f"sim:white?markers=4&seed=2&{BRIEF}"
    came = []
    camera = RigCamera("red", source=source, **SMALL)  # type: ignore[arg-type]
    with open_simulated(camera, clock, lambda _: None) as frames:
        for frame in frames:
            if frame is not None:
                assert frame.time_ns is not None
                came.append((clock.now_ns() - frame.time_ns, frame))
            if len(came) == 60:
                break
    assert min(late_ns for late_ns, _ in came) >= 4e6
    times_ns = [frame.time_ns or 0 for _, frame in came]
    steps_ns = np.array([after - before for before, after in pairwise(times_ns)])
    assert (steps_ns > 0).all()
    assert (steps_ns % (NS_PER_S // 20) == 0).all()
    # The expected markers follow from the plan of the lab and the model of the camera.
    seat = parse_source(camera)
    lab = plan_live_lab(seat.lab)
    view = mount_cameras(seat.lab)[seat.number]
    lying = {where.marker_id: where for where in lab.stationary}
    seen = set()
    for time_ns, (_, frame) in list(zip(times_ns, came, strict=True))[::3]:
        since_s = lab.time_of(image_index(round(time_ns * 20 / NS_PER_S), lab.images))
        grey = decode_grey(CompressedImage(time_ns, "red", frame.data, frame.format))
        for marker in detect_markers(grey, seat.lab.dictionary):
            where = lying.get(marker.id) or lab.drive.pose_at(marker.id, since_s)
            true_px = project_corners(view.lens, view.camera_from_world, place_marker(where, seat.lab))
            assert np.abs(marker.corners_px - true_px).mean() < 1.0
            seen.add(marker.id)
    assert len(seen & set(lying)) >= 6
    assert seen & {0, 1, 2, 3}


@pytest.mark.slow
def test_all_cameras_agree_on_the_time() -> None:
    """The same camera, opened twice with separate clocks, shows the same image at each time."""
    first = {frame.time_ns: frame.data for frame in take(f"red?{BRIEF}", 45, Clock())}
    second = {frame.time_ns: frame.data for frame in take(f"red?{BRIEF}", 45, Clock())}
    # Two loops apart, the frames are the same bytes.
    turn_ns = TURN * NS_PER_S // 20
    by_turn = {(time_ns or 0) % turn_ns: data for time_ns, data in first.items()}
    shared = [(by_turn[t], data) for time, data in second.items() if (t := (time or 0) % turn_ns) in by_turn]
    assert len(shared) > 10
    assert all(one == other for one, other in shared)


def test_a_stamp_is_of_the_instant_that_the_rig_says() -> None:
    clock = Clock()
    frames = {
        stamp: take("red?exposure_s=0.02&row_time_ns=50000&markers=1&stations=1", 1, clock, stamp=stamp)[0]
        for stamp in ("start", "end")
    }
    step_ns = NS_PER_S // 20
    assert (frames["start"].time_ns or 0) % step_ns == step_ns - 10_000_000
    assert (frames["end"].time_ns or 0) % step_ns == 10_000_000 + 539 * 50_000


def test_simulated_camera_can_be_closed_while_it_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[simulated._Images] = []
    stop = simulated._Images.stop

    def note_and_stop(images: simulated._Images) -> None:
        stopped.append(images)
        stop(images)

    monkeypatch.setattr(simulated._Images, "stop", note_and_stop)
    camera = RigCamera("closed", source="sim:red", width=1920, height=1080)
    with open_simulated(camera, Clock(), lambda _: None) as frames:
        next(frames)
    for thread in threading.enumerate():
        if thread.name == "draws closed":
            thread.join(WAIT_LIMIT_S)
            assert not thread.is_alive()
    (images,) = stopped
    assert images._film is None or len(images._drawn) < images._film.count


def test_live_lab_gives_each_camera_enough_markers_to_work_with() -> None:
    """The points are enough for the default model, most on the floor, and none covers another."""
    seat = parse_source(RigCamera("red", source="sim:red"))
    lab = plan_live_lab(seat.lab)
    cameras = mount_cameras(seat.lab)
    for number, camera in enumerate(cameras):
        film = lab_film(seat.lab, number, lambda: None)
        lying = {where.marker_id: where for where in lab.stationary}
        seen: set[int] = set()
        for index in (0, film.count // 2, film.count - 1):
            grey = decode_grey(CompressedImage(0, camera.name, film.draw(index), "jpeg"))
            ids = {marker.id for marker in detect_markers(grey, seat.lab.dictionary)}
            # No marker is ever covered by a moving one.
            assert not seen or seen & set(lying) == ids & set(lying)
            seen |= ids
        found = [lying[number] for number in seen & set(lying)]
        assert len(found) >= 18
        assert sum(where.z_m == 0 for where in found) > len(found) / 2
        assert len({where.z_m for where in found}) == 3


def test_stations_do_not_depend_on_the_frame_size() -> None:
    plans = [
        plan_live_lab(
            parse_source(RigCamera("red", source="sim:red", width=width, height=height)).lab
        ).stationary
        for width, height in ((1920, 1080), (640, 360), (640, 480))
    ]
    assert plans[0] == plans[1] == plans[2]


# Renders a board in many poses and calibrates.
@pytest.mark.slow
@pytest.mark.parametrize("text", ["6x4", "charuco:4x5"])
def test_board_before_a_camera_gives_its_lens(text: str, tmp_path: Path) -> None:
    """The images give the intrinsics as with the command; the simulator knows the focal length."""
    source = RigCamera("white", source=f"sim:white?board={text}", width=640, height=360)
    seat = parse_source(source)
    assert seat.board is not None
    film = board_film(seat.lab, seat.number, seat.board, lambda: None)
    assert film.count == POSES
    folder = tmp_path / "white"
    folder.mkdir()
    for index in range(film.count):
        (folder / f"{index:03}.jpg").write_bytes(film.draw(index))
    board = parse_board(text, 0.03, 0.75, "DICT_4X4_50", False)
    (result,) = calibrate_cameras(
        find_sources([folder], []), board, find_lens_model("fisheye"), lambda *_: None
    )
    assert isinstance(result, CalibrationResult), result
    true = mount_cameras(seat.lab)[seat.number].lens
    assert result.rms_px < 0.1
    assert math.isclose(result.lens.K[0, 0], true.K[0, 0], rel_tol=0.005)
    assert np.abs(result.lens.K[:2, 2] - true.K[:2, 2]).max() < 1.0


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("sim:green", "has no camera 'green'; write one of sim:red, sim:white, sim:black"),
        ("sim:red?colour=3", "has no setting 'colour'"),
        ("sim:red?seed=three", "seed=three is not a number"),
        ("sim:red?textured=1", "textured=1 is no switch"),
        ("sim:red?markers=0", "simulator setting markers is 0"),
        (
            "sim:red?board=6",
            "camera red: board=6: is not a board; write the inner corners of a chessboard as 6x4",
        ),
        ("sim:red?board=charuco:2x2", "a board has 3 to 100 squares in each direction"),
    ],
)
def test_a_lab_that_cannot_be(source: str, said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        parse_source(RigCamera("red", source=source))


def test_preparing_a_view_ends_between_two_steps() -> None:
    """An interrupt waits for one step of the work only."""
    calls: list[None] = []

    def check() -> None:
        calls.append(None)
        if len(calls) == 2:
            raise InterruptedError

    seat = parse_source(RigCamera("red", source="sim:red", width=320, height=180))
    with pytest.raises(InterruptedError):
        prepare_view(mount_cameras(seat.lab)[0], seat.lab, check)
