"""Shared fixtures: the real data, and the command line in this process."""

import functools
import gc
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer.main
from hypothesis import HealthCheck, settings

# As in the pipeline, and before the import of numpy: small matrices, and one process per core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A program under test compiles the package once, as after an installation, and not in each process.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

from ipsys_log.app.cli import main
from ipsys_log.capture.simulation.lab import simulate
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.capture.video_files import open_video
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedVideo, Measurement, Message
from ipsys_log.messages.channels import MEASUREMENTS
from tests.capture.streams import encode
from tests.live_recordings import record_every_frame
from tests.s3_server import open_bucket, serve_s3
from tests.shared_files import make_once
from tests.waiting import wait_until

ROOT = Path(__file__).resolve().parent.parent
# The command line installs handlers for these signals; a test restores them.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# A background runner may ignore some signals; a program under test inherits that.
for number in SIGNALS:
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)
# Examples have no time limit: benchmarks/ measures the speed, not the tests.
# The same commit is tested with the same examples; --hypothesis-profile=search draws new ones.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("repeatable", settings.get_profile("search"), derandomize=True)
settings.load_profile("repeatable")
# a program for Debian's own Python
collect_ignore = ["capture/rtsp_server.py"]


# The table of commands is the same for all tests; building it takes longer than the parsing of a command.
_build_commands = functools.cache(typer.main.get_command)


def pytest_collection_finish() -> None:
    """Exempt the modules and tests from the garbage collection: it took 15 % of the time of commands."""
    gc.collect()
    gc.freeze()


class Done(NamedTuple):
    code: int
    out: str
    err: str


Ipsys = Callable[..., Done]


@contextmanager
def small_disk(at: Path, megabytes: int) -> Iterator[Path]:
    """Mount a small separate disk; skip the test if mounting is not allowed."""
    at.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "none", str(at)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("no right to mount a small disk")
    try:
        yield at
    finally:
        subprocess.run(["umount", str(at)], check=True)


def fill_disk(at: Path) -> None:
    """Shrink a small disk to its content and 1 MB, while other programs may write to it."""

    def shrink() -> bool:
        size = shutil.disk_usage(at).used + (1 << 20)
        mount = ["mount", "-o", f"remount,size={size}", str(at)]
        # It fails if the content has become larger meanwhile.
        return subprocess.run(mount, capture_output=True, check=False).returncode == 0

    wait_until(shrink, f"{at} is almost full", lambda: shutil.disk_usage(at))


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the public data sets; docs/data.md names their sources."""
    folder = Path(os.environ.get("IPSYS_DATA", ROOT / "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data in {folder}: set IPSYS_DATA (docs/data.md says where to get them)")
    return folder


@pytest.fixture
def ipsys(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ipsys:
    """Run a command as a user does; return exit code, stdout and stderr."""

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["ipsys", *map(str, arguments)])
        monkeypatch.setattr(typer.main, "get_command", _build_commands)
        code = 0
        handlers = {number: signal.getsignal(number) for number in SIGNALS}
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        captured = capsys.readouterr()
        return Done(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="session")
def lab_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small simulated session; tests copy it before a change."""
    settings = LabSettings(
        width=960, height=540, markers=8, stations=26, frames_per_station=2, rate_hz=5.0, drive_s=1.0
    )

    def write(folder: Path) -> None:
        write_log(folder / "lab.mcap", simulate(settings))

    return make_once(tmp_path_factory, "lab", write) / "lab.mcap"


@pytest.fixture(scope="session")
def video_log(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the small simulated session as H.264, with a keyframe every ten frames.

    Tests copy it before a change.
    """

    def write(folder: Path) -> None:
        with Session([lab_log]) as session:
            write_log(folder / "lab.mcap", _with_video(session, folder))

    return make_once(tmp_path_factory, "video", write) / "lab.mcap"


def _with_video(session: Session, folder: Path) -> Iterator[Message]:
    packets = {topic: iter(_as_video(session, topic, folder)) for topic in session.images.values()}
    for message in session.messages([topic for reader in session.readers for topic in reader.channels]):
        if message.topic in packets:
            camera, data = str(message.camera), next(packets[message.topic])
            yield replace(message, payload=CompressedVideo(message.publish_time_ns, camera, data, "h264"))
        else:
            yield message


def _as_video(session: Session, topic: str, folder: Path) -> list[bytes]:
    for number, frame in enumerate(session.payloads([topic])):
        (folder / f"{number:03}.jpg").write_bytes(frame.data)
    options = "-c:v libx264 -crf 16 -bf 0 -g 10 -sc_threshold 0 -pix_fmt yuv420p"
    path = encode(folder, "video.mp4", *options.split())
    with open_video(path, print) as frames:
        return [frame.data for frame in frames]


@pytest.fixture
def lab(lab_log: Path, tmp_path: Path) -> Path:
    """Copy the small simulated session."""
    return Path(shutil.copy(lab_log, tmp_path / "lab.mcap"))


@pytest.fixture(scope="session")
def detected_log(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small simulated session with its markers and camera points, to be copied before it is changed."""

    def write(folder: Path) -> None:
        shutil.copy(lab_log, folder / "lab.mcap")
        replay([folder / "lab.mcap"], Request(), "camera-frame")

    return make_once(tmp_path_factory, "detected", write) / "lab.mcap"


@pytest.fixture
def detected_lab(detected_log: Path, tmp_path: Path) -> Path:
    """A copy of the session with its markers, for tests of later stages."""
    return Path(shutil.copy(detected_log, tmp_path / "lab.mcap"))


@pytest.fixture(scope="session")
def replayed_log(detected_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small simulated session with all stages, to be copied before it is changed."""

    def write(folder: Path) -> None:
        shutil.copy(detected_log, folder / "lab.mcap")
        replay([folder / "lab.mcap"], Request(models=("poly",)))

    return make_once(tmp_path_factory, "replayed", write) / "lab.mcap"


@pytest.fixture
def replayed_lab(replayed_log: Path, tmp_path: Path) -> Path:
    """A copy of the session with all stages."""
    return Path(shutil.copy(replayed_log, tmp_path / "lab.mcap"))


@pytest.fixture(scope="session")
def calibration(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with a model that is fitted to the small simulated session."""

    def write(folder: Path) -> None:
        replay([lab_log], Request(models=("poly",)), output=folder / "calibration.mcap")

    return make_once(tmp_path_factory, "calibration", write) / "calibration.mcap"


@pytest.fixture(scope="session")
def recorded(lab_log: Path, calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A live recording of the small simulated session with all its results, to be copied before a change."""

    def write(folder: Path) -> None:
        record_every_frame(lab_log, calibration, folder / "live.mcap")

    return make_once(tmp_path_factory, "live", write) / "live.mcap"


def data_section(path: Path) -> bytes:
    """Return the bytes before the DataEnd record, which no command may rewrite."""
    whole = path.read_bytes()
    summary_start = int.from_bytes(whole[-28:-20], "little")
    return whole[: summary_start - 13]


class Unmeasured(NamedTuple):
    """A detected session without measurements, and the tape measurements for it."""

    log: Path
    tape: list[Measurement]


@pytest.fixture(scope="session")
def unmeasured_log(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Unmeasured:
    """Return the small simulated session without its measurements; tests copy it before a change."""

    def write(folder: Path) -> None:
        with Session([lab_log]) as session:
            topics = [topic for reader in session.readers for topic in reader.channels]
            messages = session.messages(topics)
            write_log(folder / "lab.mcap", (m for m in messages if not isinstance(m.payload, Measurement)))
        replay([folder / "lab.mcap"], Request(), "camera-frame")

    with Session([lab_log]) as session:
        tape = session.payloads(session.topics(MEASUREMENTS))
    return Unmeasured(make_once(tmp_path_factory, "unmeasured", write) / "lab.mcap", tape)


@pytest.fixture
def unmeasured(unmeasured_log: Unmeasured, tmp_path: Path) -> Unmeasured:
    """Copy the session without measurements."""
    return unmeasured_log._replace(log=Path(shutil.copy(unmeasured_log.log, tmp_path / "unmeasured.mcap")))


@pytest.fixture(scope="module")
def s3_address() -> Iterator[str]:
    with serve_s3() as address:
        yield address


@pytest.fixture
def bucket(s3_address: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Open an empty bucket of a real S3 server on loopback."""
    with open_bucket(s3_address, monkeypatch) as bucket:
        yield bucket
