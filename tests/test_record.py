"""``ipsys record`` on real streams: the log contents, and the remaining data after any end."""

import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import pytest

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Message, image_topic
from ipsys_log.messages.channels import EVENTS
from ipsys_log.messages.rig_file import load_rig
from tests.capture.streams import encode, make_jpegs, serve
from tests.conftest import Ipsys
from tests.ports import free_port
from tests.tiers import first_fast
from tests.waiting import wait_until

NAMES = ("red", "white", "black")
# a limit far above any duration on a busy machine
LIMIT_S = 240


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[bytes]]:
    """Return a second of images as a stream of JPEGs."""
    folder = tmp_path_factory.mktemp("pictures")
    jpegs = make_jpegs(folder, 30)
    return encode(folder, "loop.mjpeg", "-c", "copy", "-f", "mjpeg"), jpegs


@contextmanager
def streams(video: Path, folder: Path, more: str = "") -> Iterator[Path]:
    """Return a rig of three served cameras."""
    rig = folder / "lab.toml"
    lines = ['name = "lab"', 'dictionary = "DICT_4X4_100"', "marker_length_m = 0.2"]
    with ExitStack() as stack:
        for name in NAMES:
            port = free_port()
            loop = ["-re", "-stream_loop", "-1", "-f", "mjpeg", "-framerate", "30", "-i", str(video)]
            kind = ["-f", "mpjpeg", "-content_type", "multipart/x-mixed-replace;boundary=ffmpeg"]
            address = f"http://127.0.0.1:{port}/{name}"
            stack.enter_context(serve(*loop, "-c", "copy", *kind, "-listen", "1", address, port=port))
            lines += ["[[cameras]]", f'name = "{name}"', f'source = "{address}"']
        rig.write_text("\n".join([*lines, more]))
        yield rig


def started(*arguments: object, err: IO[str] | int = subprocess.PIPE) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "ipsys_log", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=err,
        text=True,
    )


def wait_for(log: Path, size: int) -> None:
    wait_until(lambda: log.exists() and log.stat().st_size >= size, f"{log} has {size} bytes")


def frames(log: Path) -> dict[str, list[bytes]]:
    with Session([log]) as session:
        return {name: [p.data for p in session.payloads([topic])] for name, topic in session.images.items()}


def lens_yaml(width: int, height: int) -> str:
    return (
        f"%YAML:1.0\n---\nimage_width: {width}\nimage_height: {height}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ 300., 0., {width / 2 - 0.5}, 0., 300., {height / 2 - 0.5}, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n"
        "   data: [ 0., 0., 0., 0. ]\n"
    )


def test_frames_are_recorded_as_they_came_for_so_many_seconds(
    ipsys: Ipsys, pictures: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    video, jpegs = pictures
    with streams(video, tmp_path) as rig:
        start_s = time.monotonic()
        done = ipsys("record", "--rig", rig, "-o", tmp_path / "a.mcap", "--seconds", "2")
        assert time.monotonic() - start_s >= 2
    assert done.code == 0, done.err
    assert "recording into" in done.err
    found = frames(tmp_path / "a.mcap")
    assert sorted(found) == sorted(NAMES)
    for name in NAMES:
        assert f"camera {name}: {len(found[name])} frames" in done.out
        first = jpegs.index(found[name][0])
        assert found[name] == [jpegs[(first + n) % 30] for n in range(len(found[name]))]
    with Session([tmp_path / "a.mcap"]) as session:
        assert session.payloads(["/rig"]) == [load_rig(rig)]
        events = session.payloads(session.topics(EVENTS))
        said = {event.text for event in events if event.kind == "camera_setting"}
    assert said == {
        f"camera {name}: sends no capture stamps; its frames get their time of arrival" for name in NAMES
    }


def test_password_is_asked_for_and_never_shown_or_recorded(
    ipsys: Ipsys, pictures: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    log = tmp_path / "a.mcap"
    with streams(pictures[0], tmp_path) as rig:
        text = (
            rig.read_text()
            .replace("http://", "http://admin:hush-hush@")
            .replace("/red", "/red?pwd=hush-hush")
        )
        rig.write_text(text)
        done = ipsys("record", "--rig", rig, "-o", log, "--seconds", "1")
    assert done.code == 0, done.err
    assert b"hush" not in log.read_bytes()
    assert "hush" not in done.out + done.err
    done = ipsys("init", tmp_path / "again.toml", "--from", log)
    assert "in each source, replace *** by its password" in done.out
    done = ipsys("record", "--rig", tmp_path / "again.toml", "-o", tmp_path / "b.mcap", "--camera", "white")
    assert done.code == 1
    assert re.fullmatch(
        r"ipsys: camera white: http://admin:\*\*\*@\S+/white: its password is missing, because a log "
        r"holds none; replace \*\*\* by the password\n",
        done.err,
    )


def test_a_password_in_the_rig_of_a_run_is_not_recorded(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    rig = tmp_path / "lab.toml"
    assert ipsys("init", rig, "--from", lab).code == 0
    text = rig.read_text().replace("marker_length_m = 0.2", "marker_length_m = 0.21")
    rig.write_text(text + '[[cameras]]\nname = "blue"\nsource = "rtsp://admin:hush-hush@10.0.0.7/live"\n')
    # The second run computes nothing.
    for fresh in (True, False):
        before = lab.read_bytes()
        done = ipsys("camera-frame", lab, "--rig", rig)
        assert done.code == 0, done.err
        assert (lab.read_bytes() != before) == fresh
    with Session([lab]) as session:
        (given,) = (run.rig for run in session.runs() if run.rig is not None)
    assert given.camera("blue").source == "rtsp://admin:***@10.0.0.7/live"
    assert b"hush" not in lab.read_bytes()


@pytest.mark.parametrize("number", first_fast(1, [signal.SIGINT, signal.SIGTERM]))
def test_simulation_ends_cleanly_on_request(
    number: int, pictures: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    log = tmp_path / "a.mcap"
    with streams(pictures[0], tmp_path) as rig:
        program = started("record", "--rig", rig, "-o", log)
        wait_for(log, 500_000)
        program.send_signal(number)
        out, err = program.communicate(timeout=LIMIT_S)
    assert program.returncode == 0, err
    assert f"{log} written" in out
    assert all(frames(log)[name] for name in NAMES)


HANGING = """
import os, sys, time
from contextlib import contextmanager
from pathlib import Path
from ipsys_log.live_runs import pipeline
from ipsys_log.app.cli import open_cameras
from ipsys_log.app.cli.signals import InterruptError, interruptible, runs_until_stopped
from ipsys_log.errors import IpsysError
from ipsys_log.log.journal import Storage
from ipsys_log.messages import RigCamera
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.frames import Clock, Frame

what, pwrite = sys.argv[2], Storage.pwrite

@contextmanager
def opened(camera, clock, say):
    def sent():
        for number in range(10**6):
            time.sleep(0.01)
            if what == "camera" and number == 200:
                print("hangs", flush=True)
                time.sleep(1000)
            yield Frame(bytes(1000), "jpeg", clock.now_ns())
    yield sent()

def hanging(self, fd, data, offset):
    if what == "disk" and offset > 150_000:
        print("hangs", flush=True)
        time.sleep(1000)
    return pwrite(self, fd, data, offset)

def stop(attached):
    attached.stop()
    os.write(1, b"stops\\n")

@interruptible
@runs_until_stopped
def record():
    with LiveCameras([RigCamera("red", source="a:1")], opened, Clock()) as attached:
        with open_cameras._stop_after(lambda: stop(attached), None):
            pipeline.record(attached, [], Path(sys.argv[1]))

Storage.pwrite = hanging
try:
    record()
except IpsysError as error:
    sys.exit(str(error))
except InterruptError as interrupt:
    sys.exit(interrupt.exit_code)
"""


@pytest.mark.slow
@pytest.mark.parametrize("what", ["camera", "disk"])
def test_second_interrupt_ends_a_hanging_command(what: str, ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", HANGING, str(log), what],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "hangs\n"
        program.send_signal(signal.SIGINT)
        assert program.stdout.readline() == "stops\n"
        assert program.poll() is None
        program.send_signal(signal.SIGINT)
        try:
            _, err = program.communicate(timeout=LIMIT_S)
        finally:
            program.kill()
    assert (program.returncode, "Traceback" in err) == (130, False), err
    assert "ipsys: ended at once; if a log was being recorded, complete it with: ipsys repair LOG" in err
    assert ipsys("repair", log).code == 0
    # The disk hangs at the first write that begins after 150 frames; a write has up to 100 frames, a second.
    assert 80 < len(frames(log)["red"]) <= {"camera": 200, "disk": 250}[what]


def test_interrupt_does_not_wait_for_the_rendering(tmp_path: Path) -> None:
    rig = tmp_path / "lab.toml"
    rig.write_text(
        'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
        '[[cameras]]\nname = "red"\nsource = "sim:red"\nwidth = 7680\nheight = 4320\n'
    )
    program = started("record", "--rig", rig, "-o", tmp_path / "a.mcap")
    assert program.stderr is not None
    assert "shows the simulated lab" in program.stderr.readline()
    program.send_signal(signal.SIGINT)
    before_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    try:
        _, err = program.communicate(timeout=LIMIT_S)
    finally:
        program.kill()
    assert (program.returncode, "Traceback" in err) == (0, False), err
    assert "stopped before the first frame was recorded; no log was written" in err
    # The preparation of the view alone takes longer.
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before_s < 8
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.slow
def test_recorder_killed_at_once_keeps_rig_and_lenses(ipsys: Ipsys, tmp_path: Path) -> None:
    played, rig, log = tmp_path / "played.mcap", tmp_path / "lab.toml", tmp_path / "a.mcap"
    large = [CompressedImage(n * 10**8, "red", bytes(500_000), "jpeg") for n in range(300)]
    write_log(played, (Message(image_topic("red"), i.timestamp, i.timestamp, i, "red") for i in large))
    (tmp_path / "red.yaml").write_text(lens_yaml(640, 480))
    rig.write_text(
        'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
        f'[[cameras]]\nname = "red"\nsource = "file:{played}"\ncalibration = "red.yaml"\n'
    )
    program = started("record", "--rig", rig, "-o", log)
    wait_for(log, 8_000_000)  # the first chunk of frames is complete: it spans a second at most
    program.kill()
    program.communicate(timeout=LIMIT_S)
    assert ipsys("repair", log).code == 0
    with Session([log]) as session:
        assert session.count(image_topic("red")) > 0
        assert session.payloads(["/rig"]) == [load_rig(rig)]
        (lens,) = session.payloads([session.calibrations["red"]])
    assert (lens.width, lens.K[0, 0]) == (640, 300.0)


@pytest.mark.slow
def test_recorder_that_stood_still_names_its_late_frames(
    pictures: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    """The position of each image in the loop gives its sending time."""
    log, said, (video, jpegs) = tmp_path / "a.mcap", tmp_path / "said.txt", pictures
    with streams(video, tmp_path) as rig, said.open("w") as err_file:
        program = started("record", "--rig", rig, "-o", log, err=err_file)
        wait_for(log, 500_000)
        program.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, program.pid, os.WSTOPPED | os.WNOWAIT)
        stopped_s = time.monotonic()
        size = log.stat().st_size
        while time.monotonic() < stopped_s + 1.5:
            time.sleep(0.05)
        program.send_signal(signal.SIGCONT)
        wait_for(log, size + 2_000_000)
        wait_until(
            lambda: said.read_text().count("arrive in time again") == len(NAMES),
            "the frames of all cameras arrive in time again",
            said.read_text,
        )
        program.send_signal(signal.SIGINT)
        program.communicate(timeout=LIMIT_S)
    err = said.read_text()
    assert program.returncode == 0, err
    with Session([log]) as session:
        events = [e for e in session.payloads(["/events"]) if e.kind == "stamp_unreliable"]
        images = {name: session.payloads([topic]) for name, topic in session.images.items()}
    for name in NAMES:
        ranges = [(e.start, e.end) for e in events if e.camera == name and e.end is not None]
        assert any(end - start > 1.4e9 for start, end in ranges), err
        late = late_by_s(images[name], jpegs)
        unnamed = [
            seconds
            for image, seconds in zip(images[name], late, strict=True)
            if not any(start <= image.timestamp <= end for start, end in ranges)
        ]
        assert max(late) > 0.8, "nothing came late: the test shows nothing"
        assert max(unnamed) < 0.5


def late_by_s(images: list[CompressedImage], jpegs: list[bytes]) -> list[float]:
    """Return the delay of each picture relative to the first, at 30/s. No picture is lost."""
    first = jpegs.index(images[0].data)
    assert [image.data for image in images] == [jpegs[(first + n) % 30] for n in range(len(images))]
    return [(image.timestamp - images[0].timestamp) / 1e9 - n / 30 for n, image in enumerate(images)]


@pytest.mark.slow
def test_renamed_log_is_recorded_to_its_end(pictures: tuple[Path, list[bytes]], tmp_path: Path) -> None:
    """Another program has taken the old name of the log: it is not touched."""
    old, new = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with streams(pictures[0], tmp_path) as rig:
        program = started("record", "--rig", rig, "-o", old, "--detect")
        wait_for(old, 500_000)
        old.rename(new)
        old.write_bytes(b"notes")
        wait_for(new, new.stat().st_size + 4_000_000)
        program.send_signal(signal.SIGINT)
        _, err = program.communicate(timeout=LIMIT_S)
    assert program.returncode == 1
    assert f"{old}: another program has renamed the log" in " ".join(err.split())
    assert old.read_bytes() == b"notes"
    assert sorted(frames(new)) == sorted(NAMES)


def test_existing_file_is_overwritten_only_with_the_option(
    ipsys: Ipsys, pictures: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes(b"years of data")
    with streams(pictures[0], tmp_path) as rig:
        done = ipsys("record", "--rig", rig, "-o", log, "--seconds", "1")
        assert done.code == 1
        assert "exists already; give another name, or --force" in done.err
        assert log.read_bytes() == b"years of data"
        assert ipsys("record", "--rig", rig, "-o", log, "--seconds", "1", "--force").code == 0
    assert len(frames(log)["red"]) > 10


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        ('name = "red"', "no camera has a source"),
        ('name = "red"\nsource = "carrier_pigeon:7"', "'carrier_pigeon:7' has an unknown type; use one of"),
    ],
)
def test_a_rig_that_cannot_be_recorded(ipsys: Ipsys, tmp_path: Path, cameras: str, said: str) -> None:
    rig = tmp_path / "lab.toml"
    rig.write_text(
        f'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n[[cameras]]\n{cameras}\n'
    )
    done = ipsys("record", "--rig", rig, "-o", tmp_path / "a.mcap", "--seconds", "1")
    assert done.code == 1
    assert done.err.startswith("ipsys: ")
    assert said in done.err
    assert not (tmp_path / "a.mcap").exists()


def test_calibration_is_scaled_to_another_size_of_the_same_shape(
    ipsys: Ipsys, pictures: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    def lens(width: int, height: int) -> Path:
        path = tmp_path / f"{width}.yaml"
        path.write_text(lens_yaml(width, height))
        return path

    with streams(pictures[0], tmp_path) as rig:
        once = ("record", "--rig", rig, "--camera", "red", "--seconds", "1", "-o")
        done = ipsys(*once, tmp_path / "a.mcap", "--calibration", f"red={lens(640, 400)}")
        assert done.code == 1
        assert (
            "sends 320 x 240 px, but its calibration is for 640 x 400, with another aspect ratio" in done.err
        )
    with streams(pictures[0], tmp_path) as rig:
        done = ipsys(*once, tmp_path / "b.mcap", "--calibration", f"red={lens(640, 480)}")
        assert "camera red: its calibration is scaled from a width of 640 px to 320 px" in done.err
    video = encode(pictures[0].parent, "red.mp4", "-c:v", "libx264", "-bf", "0", "-pix_fmt", "yuv420p")
    rig.write_text(re.sub(r"http://\S+/red", f"file:{video}", rig.read_text()))
    done = ipsys(*once, tmp_path / "c.mcap", "--calibration", f"red={lens(640, 400)}")
    assert "sends 320 x 240 px, but its calibration is for 640 x 400, with another aspect ratio" in done.err
    with Session([tmp_path / "b.mcap"]) as session:
        (held,) = session.payloads([session.calibrations["red"]])
    assert (held.width, held.height, held.K[0, 0], held.K[0, 2]) == (320, 240, 150.0, 159.5)


def test_input_is_not_overwritten(ipsys: Ipsys, lab_log: Path, tmp_path: Path) -> None:
    played, rig, lens = tmp_path / "red.mcap", tmp_path / "lab.toml", tmp_path / "lens.mcap"
    for path in (played, lens):
        path.write_bytes(lab_log.read_bytes())
    head = 'name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'
    rig.write_text(f'{head}[[cameras]]\nname = "red"\nsource = "file:{played}"\n')
    files = {path: path.read_bytes() for path in (played, rig, lens)}
    once = ("--rig", rig, "--calibration", lens, "--force", "--seconds", "1", "-o")
    for path, said in ((played, "is the source of camera red"), (lens, "is a calibra")):
        assert said in ipsys("record", *once, path).err
    model = ("--model-from", lab_log, *once)
    done = ipsys("record", "--measure", *model, lab_log)
    assert f"-o {lab_log}: is the log with the model" in done.err
    assert f"-o {lab_log}: is the log with the model" in ipsys("live", *model, lab_log).err
    assert {path: path.read_bytes() for path in files} == files
    # before a camera is opened
    for count in (243, 249, 300):
        done = ipsys("record", *once, tmp_path / ("x" * count))
        assert done.code == 1
        assert "File name too long" in done.err
        assert "opening" not in done.err + done.out
        assert "Traceback" not in done.err
