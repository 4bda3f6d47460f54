"""The size of a recording, and the time until the disk is full, before and during a recording."""

import math
import re
import shutil
from collections import namedtuple
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.app.cli import open_cameras as open_cameras_module
from ipsys_log.app.cli.open_cameras import open_cameras, prepare_lab
from ipsys_log.app.report.cameras import LiveStatus
from ipsys_log.capture.disk import DiskRoom, expected_bytes_per_s, free_room
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.live_check import CameraMonitor
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Message, Rig, RigCamera, image_topic
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys, small_disk
from tests.sinks.streaming import judged

RIG = Rig("lab", "DICT_4X4_100", 0.2)
Usage = namedtuple("Usage", "total used free")


def rig_that_plays(lab: Path, more: str = "") -> Path:
    path = lab.parent / "lab.toml"
    text = 'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
    for name in ("red", "white"):
        text += (
            f'[[cameras]]\nname = "{name}"\nsource = "file:{lab}?{name}"\ncalibration = "{lab.name}"\n{more}'
        )
    path.write_text(text)
    return path


def status_line(status: LiveStatus) -> tuple[str, str]:
    """Return the last line of the display during a recording, and its style."""
    text = status.show().renderables[-1]
    return str(text), str(text.style)  # type: ignore[union-attr]


@contextmanager
def opening(rig: Path, log: Path, seconds: float | None, doing: str | None = None) -> Iterator[LiveStatus]:
    """Open the cameras as a command does; write nothing."""
    with open_cameras(prepare_lab(rig, None, None), log, seconds, doing) as (opened, status):
        yield status
        opened.cameras.stop()
        log.touch()


def first_bytes(lab: Path) -> int:
    """Return the size of the first frames of both cameras together."""
    with Session([lab]) as session:
        return sum(len(session.payloads([session.images[name]])[0].data) for name in ("red", "white"))


@pytest.mark.parametrize("command", [("record",), ("record", "--detect")])
def test_free_disk_time_is_printed_before_the_recording(
    ipsys: Ipsys, lab: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    rig = rig_that_plays(lab, "rate_hz = 5\n")
    done = ipsys(*command, "--rig", rig, "-o", tmp_path / "a.mcap", "--seconds", "2")
    assert done.code == 0, done.err
    said = re.search(r"about ([\d.]+) MB in 2 s; [\d.]+ [GT]B free in \S+: enough for", done.err)
    assert said is not None, done.err
    assert said.start() < done.err.index("the cameras are open")
    assert math.isclose(float(said[1]) * 1e6, 2 * 5 * first_bytes(lab), abs_tol=0.06e6)


def test_measure_prints_the_size_of_one_point(
    capsys: pytest.CaptureFixture[str], lab: Path, tmp_path: Path
) -> None:
    """There is no rate, because only measured frames are kept."""
    with opening(rig_that_plays(lab), tmp_path / "a.mcap", None, "measuring") as status:
        line, _ = status_line(status)
    assert line.endswith("left on the disk")
    said = re.search(r"about ([\d.]+) MB for each point; [\d.]+ [GT]B free in", capsys.readouterr().err)
    assert said is not None
    assert math.isclose(float(said[1]) * 1e6, 1.5 * 30 * first_bytes(lab), abs_tol=0.06e6)


def test_small_disk_is_warned_of_before_the_start(
    capsys: pytest.CaptureFixture[str], lab: Path, tmp_path: Path
) -> None:
    """Use a separate disk of 20 MB; half of it is reserved for the end of the log."""
    rig = rig_that_plays(lab, "rate_hz = 30\n")
    with small_disk(tmp_path / "disk", 20) as disk:
        with opening(rig, disk / "a.mcap", None):
            said = capsys.readouterr().err
        assert re.search(rf"a minute; 10.5 MB free in {disk}: full after 2 s", said)
        assert "to use less disk space: a lower rate_hz in lab.toml (15 halves it)" in said
        with opening(rig, disk / "b.mcap", 1.0):
            assert re.search(r"MB in 1 s; .*: enough for 2 s", capsys.readouterr().err)
        # The cameras are only previewed: a message appears only if the disk is too small even for that.
        with opening(rig, disk / "c.mcap", 1.0, "recording for 1 s"):
            assert "free in" not in capsys.readouterr().err
        with opening(rig, disk / "d.mcap", 60.0, "recording for 60 s"):
            assert "full after 2 s" in capsys.readouterr().err


def test_displayed_disk_time_uses_the_measured_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The estimate is 10 MB/s and the measured rate 2 MB/s: the disk lasts five times as long."""
    log = tmp_path / "a.mcap"
    log.write_bytes(bytes(20_000_000))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**12, 0, 6_000_000_000))
    now_s = [0.0]
    with CameraMonitor(RIG) as monitor:
        status = LiveStatus({}, monitor, log, lambda: now_s[0], 10e6)
        now_s[0] = 1.0
        assert status_line(status) == ("1 s, 20.0 MB; 6.0 GB left on the disk, enough for 10 minutes", "")
        now_s[0] = 10.0
        assert status_line(status) == ("10 s, 20.0 MB; 6.0 GB left on the disk, enough for 50 minutes", "")
        monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**12, 0, 600_000_000))
        line, style = status_line(status)
        assert line.endswith("600.0 MB left on the disk, enough for 5 minutes")
        assert "red" in style


def test_recording_is_reported_when_the_first_frame_is_on_the_disk(tmp_path: Path) -> None:
    """The rig comes before the frame, and the frame waits in memory at first."""
    log, now_s = tmp_path / "a.mcap", [0.0]
    said: list[str] = []
    log.write_bytes(bytes(100))
    image = CompressedImage(0, "red", bytes(5_000), "jpeg")
    with CameraMonitor(RIG) as monitor:
        status = LiveStatus({}, monitor, log, lambda: now_s[0], None, said.append)
        rig = Message("/rig", 10 * NS_PER_S, 10 * NS_PER_S, RIG)
        status(rig)
        log.write_bytes(bytes(2_000))
        status(Message("/cameras/red/image", 11 * NS_PER_S, 11 * NS_PER_S, image, "red"))
        log.write_bytes(bytes(6_000))
        status(rig)
        assert said == []
        log.write_bytes(bytes(7_100))
        status(rig)
        status(rig)
        assert said == [f"recording into {log}; Ctrl-C to end"]
        # The log has two seconds, whatever the opening of the cameras and the end of the log take.
        status(Message("/cameras/red/image", 12 * NS_PER_S, 12 * NS_PER_S, image, "red"))
        now_s[0] = 900.9
        assert status.summary()[0] == f"{log} written: 2.0 s, 7.1 kB"


def image(camera: str, time_s: float) -> Message:
    time_ns = round(time_s * NS_PER_S)
    return Message(
        image_topic(camera), time_ns, time_ns, CompressedImage(time_ns, camera, b"", "jpeg"), camera
    )


def test_camera_that_delivers_fewer_frames_is_named(tmp_path: Path) -> None:
    sources = {"red": "usb:0", "white": "sim:white", "black": "usb:2", "gate": "file:gate.mp4"}
    cameras = [RigCamera(name, source=source, rate_hz=10.0) for name, source in sources.items()]
    frames = {"red": 19, "white": 14, "black": 50, "gate": 3}
    states = {name: CameraState(frames=count) for name, count in frames.items()}
    with CameraMonitor(RIG) as monitor:
        status = LiveStatus(states, monitor, tmp_path / "a.mcap", lambda: 0.0, cameras=cameras)
        status(Message("/rig", 0, 0, RIG))  # before the cameras were open
        for time_s in (10.0, 15.2):
            status(image("red", time_s))
        assert [line for line in status.summary() if " delivers " in line] == [
            "camera red delivers 3.7 of 10 frames/s: check its exposure_s, its cable and the load of this "
            "computer, or lower rate_hz in the rig",
            "camera white delivers 2.7 of 10 frames/s: this computer draws its images too slowly; lower "
            "rate_hz in the rig",
        ]


def test_display_shows_late_positions_with_their_cause(tmp_path: Path) -> None:
    with CameraMonitor(RIG) as monitor:
        status = LiveStatus({}, monitor, tmp_path / "a.mcap", lambda: 0.0, positions=judged("late"))
        shown = [str(part) for part in status.show().renderables]
        assert "positions are late: 0.4 s. The cause. The remedy" in shown


def test_seconds_count_from_the_first_processed_frame(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    timers: list[list[Any]] = []

    class Timer:
        def __init__(self, seconds: float, _: object) -> None:
            self.row = [seconds, "made"]
            timers.append(self.row)

        def start(self) -> None:
            self.row[1] = "runs"

        def cancel(self) -> None:
            self.row[1] = "cancelled"

    monkeypatch.setattr(open_cameras_module, "Timer", Timer)
    with opening(rig_that_plays(lab), tmp_path / "a.mcap", 10.0) as status:
        status(Message("/rig", 0, 0, RIG))
        assert timers == [[70.0, "runs"]]  # the command also ends without any frame
        status(image("red", 1.0))
        status(image("red", 2.0))
        assert timers == [[70.0, "cancelled"], [10.0, "runs"]]
    assert timers[1][1] == "cancelled"


def test_expected_rate_is_that_of_the_rig_and_the_first_frames() -> None:
    cameras = [RigCamera("red", rate_hz=15.0), RigCamera("white"), RigCamera("gate", rate_hz=30.0)]
    states = {
        "red": CameraState(first_bytes=100_000, format="jpeg", size_px=(1280, 720)),
        "white": CameraState(first_bytes=50_000, format="jpeg", size_px=(640, 480)),
        # The first frame of a video is a keyframe, so its size gives no rate.
        "gate": CameraState(first_bytes=400_000, format="h264", size_px=(1920, 1080)),
    }
    video = expected_bytes_per_s(cameras[2:], states)
    assert 4e6 / 8 < video < 10e6 / 8
    assert expected_bytes_per_s(cameras, states) == 15 * 100_000 + 30 * 50_000 + video


def test_advice_needs_a_large_recording_or_a_small_disk(tmp_path: Path) -> None:
    cameras = [RigCamera("red", rate_hz=30.0)]
    jpeg, video = (CameraState(1, 1, format=name, first_bytes=1) for name in ("jpeg", "h264"))
    assert DiskRoom(tmp_path, 10**12, 1e6).advise(cameras, {"red": jpeg}) is None
    advice = DiskRoom(tmp_path, 10**12, 25e6).advise(cameras, {"red": jpeg})
    assert advice is not None
    assert "JPEG quality or H.264" in advice
    assert "--points-only" in advice
    short = DiskRoom(tmp_path, 10**8, 1e6).advise(cameras, {"red": video})
    assert short is not None
    assert "JPEG" not in short


def test_room_leaves_out_what_is_set_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**12, 0, 10**9))
    assert free_room(tmp_path / "a.mcap", 1.0).free_bytes == 10**9 - (64 << 20)
    assert free_room(tmp_path / "a.mcap", 0.0).remaining_s is None
