"""A killed recorder, or a full disk: the restored data and its runs."""

import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from ipsys_log.engine.output import write_message
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.live_runs.restore import finish_runs
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import ChunkRef
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import FRAME_SKIPPED, Message, Tracks
from ipsys_log.messages.channels import EVENTS, MARKERS
from ipsys_log.stages.detect import Detect
from ipsys_log.tools.verify import verify
from tests.conftest import Ipsys, fill_disk, small_disk
from tests.live_recordings import go_live, slow
from tests.tiers import first_fast
from tests.waiting import wait_until

# a limit far above any duration on a busy machine
LIMIT_S = 240

RIG = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
"""


# Moving robots, in frames so large that each second fills a chunk.
SCENE = "stations=0&noise_sigma=2&jpeg_quality=90"


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """Return two cameras of the simulated lab with so many frames that one always waits."""
    path = tmp_path / "lab.toml"
    cameras = (
        f'[[cameras]]\nname = "{name}"\nsource = "sim:{name}?{SCENE}"\nwidth = 480\nheight = 270\n'
        "rate_hz = 25\n"
        for name in ("red", "white")
    )
    path.write_text(RIG + "".join(cameras))
    return path


@contextmanager
def going_live(rig: Path, model: Path, log: Path, size: int) -> Iterator[subprocess.Popen[str]]:
    """Return ``ipsys live`` after its log has a given size in bytes."""
    command = ["live", "--rig", rig, "--model-from", model, "-o", log]
    program = subprocess.Popen(
        [sys.executable, "-m", "ipsys_log", *map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until(
            lambda: log.exists() and log.stat().st_size >= size, f"{log} has {size} bytes", programs=[program]
        )
        yield program
    finally:
        program.kill()
        program.communicate()


def wait_for_markers(log: Path, copy: Path) -> None:
    """Wait until the log that is being recorded has markers of each camera."""

    def has_markers() -> bool:
        shutil.copy(log, copy)
        repair(copy)
        with Session([copy]) as session:
            counts = [session.count(f"/runs/edges/cameras/{camera}/markers") for camera in session.images]
        return bool(counts) and all(counts)

    wait_until(has_markers, "the log has markers of each camera")


def equal(log: Path) -> bool:
    return all(one.equal for one in verify([log], None, lambda stage, done, total: None))


def finish(log: Path) -> list[tuple[str, str]]:
    repair(log)
    return [(one.stage, one.run) for one in finish_runs(log, lambda stage, done, total: None)]


def skipped(session: Session, camera: str) -> int:
    return sum((one.kind, one.camera) == (FRAME_SKIPPED, camera) for one in session.payloads(["/events"]))


def topics_of(log: Path) -> set[str]:
    with Session([log]) as session:
        return {topic for reader in session.readers for topic in reader.channels}


LIVE = [("detect", "edges"), ("camera-frame", "edges"), ("locate", "poly"), ("fuse", "poly")]


@pytest.mark.slow
def test_killed_live_run_is_completed_by_repair(
    ipsys: Ipsys, rig: Path, calibration: Path, tmp_path: Path
) -> None:
    log = tmp_path / "monday.mcap"
    with going_live(rig, calibration, log, 3_000_000) as program:
        for command in ("info", "replay", "verify", "latency", "view"):
            done = ipsys(command, log)
            assert (done.code, done.err.count("\n")) == (1, 1)
            assert "is being recorded or written now" in done.err
        assert "another process is writing it" in ipsys("repair", log).err
        wait_for_markers(log, tmp_path / "copy.mcap")
        assert program.poll() is None
        program.send_signal(signal.SIGKILL)
        program.wait(LIMIT_S)
        written_ns = log.stat().st_mtime_ns
    for command in ("info", "replay", "verify", "measure", "latency", "view"):
        done = ipsys(command, log)
        assert done.code == 1
        assert f"its recorder was killed, or the file was cut off. Its messages can be saved. Run: ipsys repair {log}" in done.err  # fmt: skip # noqa: E501
    done = ipsys("repair", log)
    assert done.code == 0, done.err
    assert "monday.mcap repaired" in done.out
    assert "The file was last written at" in done.out
    with Session([log]) as session:
        for camera, topic in session.images.items():
            last_ns, _ = session.last([topic])
            (line,) = (one for one in done.out.splitlines() if topic in one)
            *_, gone, _, rate = line.split()
            rate_hz = float(rate.removesuffix("/s"))
            assert rate_hz <= 25, line  # not all frames are rendered in time on a busy machine
            # Frames that were taken until one second after the last writing are missing, at most.
            assert float(gone) == pytest.approx((written_ns + 1e9 - last_ns) / 1e9 * rate_hz, rel=0.05, abs=1)
            looked_at = session.count(f"/runs/edges/cameras/{camera}/markers")
            assert looked_at + skipped(session, camera) == session.count(topic)
            assert looked_at > 0
    assert ipsys("verify", log).out.endswith("the replay is identical to the log\n")
    # A busy machine skips frames; a replay of all frames would be another run.
    done = ipsys("replay", log, "--as-live")
    assert done.code == 0, done.err
    assert "nothing to do: all results are up to date" in done.err
    assert not [topic for topic in topics_of(log) if "_2/" in topic]
    again = pipeline.replay([log], Request(model_from=calibration, as_live=True))
    assert not any(one.fresh for one in again)


@pytest.mark.parametrize("share", first_fast(1, [0.3, 0.6, 0.95]))
def test_skipped_frames_are_processed_by_a_replay(recorded: Path, tmp_path: Path, share: float) -> None:
    """The kill is between two writes: frames are there, but no results of the last frames."""
    chunks = sorted(_chunks(recorded), key=lambda chunk: chunk.offset)
    # The first small chunk has the settings of the recording, the second has results.
    _, results, *_ = (chunk for chunk in chunks if chunk.compression)
    images = [chunk for chunk in chunks if not chunk.compression and chunk.offset > results.offset]
    last = images[int(share * len(images))]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recorded.read_bytes()[: last.end])
    repair(cut)
    with Session([cut]) as session:
        frames = sum(session.count(topic) for topic in session.images.values())
        markers = sum(session.count(topic) for topic in session.topics(MARKERS, "edges"))
        assert frames > markers > 0
    assert finish(cut) == [
        ("detect", "edges"),
        ("camera-frame", "edges"),
        ("locate", "poly"),
        ("fuse", "poly"),
    ]
    assert equal(cut)
    with Session([cut]) as session, Session([recorded]) as whole:
        assert sum(session.count(topic) for topic in session.topics(MARKERS, "edges")) == frames
        ours, theirs = (s.payloads(["/runs/poly/tracks"]) for s in (session, whole))
        assert [one.timestamp for one in ours] == [one.timestamp for one in theirs[: len(ours)]]
    assert finish(cut) == []
    assert not any(one.fresh for one in pipeline.replay([cut], Request()))


def _chunks(log: Path) -> Iterator[ChunkRef]:
    with LogReader(log) as reader:
        yield from reader._contents.chunks


@pytest.mark.slow
def test_run_with_other_content_is_left_unchanged(recorded: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    """No record is written for a wrong run."""
    log = tmp_path / "other.mcap"
    with Session([recorded]) as session, LogWriter.create(log) as writer:
        counts: dict[str, int] = {}
        for message in session.messages(topics_of(recorded)):
            if not message.topic.endswith("edges/record") and _stage(message) not in ("locate", "fuse"):
                write_message(writer, _moved(message, session.end_ns), counts)
    done = ipsys("repair", log)
    assert done.code == 0, done.err
    assert "run poly stays unfinished: /runs/poly/tracks has other content at" in done.err
    apart = {one.topic for one in verify([log], None, lambda *_: None) if not one.equal}
    assert apart == {"/runs/poly/tracks", "/runs/poly/poses"}
    with Session([log]) as session:
        assert session.count("/runs/poly_2/tracks") == session.count("/runs/poly/tracks")


def _stage(message: Message) -> str | None:
    return getattr(message.payload, "stage", None) if message.topic.endswith("/record") else None


def _moved(message: Message, end_ns: int) -> Message:
    """Move a robot slightly in the second half."""
    if (
        not isinstance(message.payload, Tracks)
        or message.log_time_ns < end_ns - 1e9
        or not message.payload.tracks
    ):
        return message
    first, *rest = message.payload.tracks
    return replace(
        message, payload=replace(message.payload, tracks=(replace(first, x_m=first.x_m + 1e-12), *rest))
    )


@pytest.mark.slow
def test_frames_that_were_skipped_stay_skipped(
    lab_log: Path, calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    with monkeypatch.context() as patch:
        patch.setattr(Detect, "__call__", slow(Detect.__call__))
        go_live(lab_log, calibration, whole, 15.0)
    # Frames are written just before the results of earlier frames: the kill is between the two.
    chunks = sorted(_chunks(whole), key=lambda chunk: chunk.offset)
    *_, before_end, _signed = (chunk.offset for chunk in chunks if chunk.compression)
    cut.write_bytes(whole.read_bytes()[:before_end])
    assert finish(cut) == LIVE
    assert equal(cut)
    with Session([cut]) as session:
        skipped = [e for e in session.payloads(session.topics(EVENTS)) if e.kind == "frame_skipped"]
        frames = sum(session.count(topic) for topic in session.images.values())
        markers = sum(session.count(topic) for topic in session.topics(MARKERS, "edges"))
    assert len(skipped) > 5
    assert markers == frames - len(skipped)


# A live recording until a real disk is full, then a replay of it.
@pytest.mark.slow
def test_a_full_disk_ends_live_with_runs_that_are_signed(
    ipsys: Ipsys, rig: Path, calibration: Path, tmp_path: Path
) -> None:
    with small_disk(tmp_path / "disk", 1000) as disk:
        log = disk / "a.mcap"
        with going_live(rig, calibration, log, 10_000) as program:
            wait_for_markers(log, tmp_path / "copy.mcap")
            fill_disk(disk)
            out, err = program.communicate(timeout=LIMIT_S)
        verified, replayed = ipsys("verify", log), ipsys("replay", log, "--as-live")
        assert equal(log)
        with Session([log]) as session:
            frames = sum(session.count(topic) for topic in session.images.values())
            markers = sum(session.count(topic) for topic in session.topics(MARKERS, "edges"))
    assert program.returncode == 1, out
    assert "the disk is full; the recording has stopped. The log is complete" in err
    assert verified.out.endswith("the replay is identical to the log\n")
    assert "nothing to do: all results are up to date" in replayed.err
    assert frames >= markers > 0
