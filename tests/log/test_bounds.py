"""A small file cannot cost much time or memory; a true recording is never refused."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import LARGEST_CHUNK, LARGEST_MESSAGE, BoundError, ReadLimits, chunk_excess
from ipsys_log.log.codec import encode, schema_data
from ipsys_log.log.contents import Schema
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import Markers, RawImage
from tests.conftest import ROOT
from tests.log.bombs import BOMBS, MIB, Attack, compress, message
from tests.log.conftest import POINT

FAST = [
    "one chunk of 1 GiB, zstd, no summary",
    "one chunk of 255 MiB, zstd, no summary",
    "60 chunks of 16 MiB, zstd",
    "7 M private records",
    "2 M messages without payload",
    "65 k channels in a chunk",
    "one message 50 k times",
    "10 k nested messages",
    "7 M camera points",
    "JSON 200 k deep",
    "JSON of 5 M objects",
    "ROS 2 definition with empty items",
    "40 k runs",
]
NATURAL = [*(ROOT / "sample_logs").glob("*.mcap"), *(ROOT / "tests/golden").glob("*.mcap")]


def read_all(path: Path) -> None:
    with Session([path]) as session:
        session.runs()
        for topic in session.readers[0].channels:
            for _ in session.messages([topic]):
                pass


@pytest.mark.parametrize("name", FAST)
def test_small_file_that_asks_for_much_is_refused_soon(name: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(BOMBS[name]())
    start_s = time.thread_time()
    with pytest.raises(LogError) as caught:
        read_all(path)
    assert time.thread_time() - start_s < 2.0
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


class Cost(NamedTuple):
    code: int
    cpu_s: float
    peak_mb: float
    err: str


def run(*arguments: object) -> Cost:
    """Run a command in a separate process that may not exceed its bounds much."""

    command = ["prlimit", "--cpu=30", f"--as={4 << 30}", sys.executable, "-m", "ipsys_log"]
    command += map(str, arguments)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment, text=True
    ) as process:
        assert process.stderr is not None
        err = process.stderr.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    return Cost(process.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss / 1000, err)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Cost]:
    """Return the cost of each command on a log of one image: the start of Python, and imports."""
    folder = tmp_path_factory.mktemp("plain")
    path = folder / "a.mcap"
    path.write_bytes(BOMBS["JPEG of 65500 x 65500"]())
    return {command: run(command, path) for command in COMMANDS}


@pytest.fixture(scope="module")
def start_cpu_s() -> float:
    """Return the processor time in which this machine, as busy as now, starts the program."""
    return run("--version").cpu_s


# The most processor time above that of a plain log, in starts of the program: 5 s if a start takes 0.2 s.
STARTS = 25
COMMANDS = ("repair", "check")


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_commands_on_a_small_file_stay_within_bounds(
    name: str, tmp_path: Path, plain: dict[str, Cost], start_cpu_s: float
) -> None:
    data = BOMBS[name]()
    assert len(data) <= 1.1 * MIB
    for command in COMMANDS:
        path = tmp_path / f"{command}.mcap"
        path.write_bytes(data)
        cost = run(command, path)
        assert cost.code in (0, 1) or (cost.code, command) == (2, "check"), cost
        assert "Traceback" not in cost.err
        assert cost.cpu_s - plain[command].cpu_s < STARTS * start_cpu_s, (command, cost, start_cpu_s)
        assert cost.peak_mb - plain[command].peak_mb < 300, (command, cost)
        if cost.code:
            assert path.read_bytes() == data


@pytest.mark.parametrize("path", NATURAL, ids=lambda path: path.stem)
def test_true_recordings_stay_far_below_every_bound(path: Path) -> None:
    with Session([path]) as session:
        [reader] = session.readers
        allowed, contents = reader.read_limits, reader._contents
        packed = [chunk for chunk in contents.chunks if chunk.compression]
        items = sum(
            16 + sum(len(value) for value in vars_of(message.payload) if isinstance(value, tuple))
            for message in session.messages(reader.channels)
        )
    assert sum(chunk.uncompressed_size for chunk in packed) < 0.1 * allowed.max_unpacked
    assert reader.message_count < 0.25 * allowed.max_records
    assert len(reader.channels) < 0.1 * allowed.max_channels
    assert items < 0.5 * allowed.max_items


def vars_of(payload: object) -> list[object]:
    return [getattr(payload, name) for name in payload.__dataclass_fields__]  # type: ignore[attr-defined]


@given(st.integers(0, 1 << 40), st.integers(0, 1 << 40))
def test_chunk_is_refused_above_its_size_or_ratio_alone(packed: int, unpacked: int) -> None:
    too_large = unpacked > 256 * MIB
    too_dense = unpacked > 16 * MIB and unpacked > 200 * packed
    assert bool(chunk_excess(packed, unpacked)) == (too_large or too_dense)


def test_work_on_one_chunk_counts_once() -> None:
    allowance = ReadLimits(1000)
    for _ in range(100):
        assert allowance.unpack(8, 16 * MIB) == ""
        allowance.count_records(8, 10_000)
    assert allowance.unpack(9, 113 * MIB)
    assert allowance.records_left(8) == allowance.max_records
    assert allowance.records_left(9) == allowance.max_records - 10_000


def black_frames(path: Path, compression: str, with_size: bool, claim: int = 0) -> Path:
    """Write raw images as another program does: 20 MiB of black, packed 1000 to 1."""
    attack = Attack()
    attack.channel(RawImage, "/image")
    frame = message(encode(RawImage(0, "a", 5120, 4096, "mono8", 5120, bytes(20 * MIB))))
    packed = compress(compression, frame)
    if not with_size:
        packed = zstandard.ZstdCompressor(write_content_size=False).compress(frame)
    attack.chunk(frame, [(0, 0)], name=compression, packed=packed, size=claim or len(frame))
    path.write_bytes(attack.finish())
    return path


@pytest.mark.parametrize("with_size", [True, False])
def test_repair_leaves_a_refused_log_as_it_is(with_size: bool, tmp_path: Path) -> None:
    """The chunk is not damaged: a cut would lose readable data."""
    path = black_frames(tmp_path / "black.mcap", "zstd", with_size)
    before = path.read_bytes()
    for act in (read_all, repair):
        with pytest.raises(BoundError, match="mcap decompress"):
            act(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("with_size", [True, False])
def test_repair_takes_a_false_claim_for_damage(with_size: bool, tmp_path: Path) -> None:
    """One flipped bit in the size of a chunk does not make a bomb: its message is saved."""
    path = tmp_path / "a.mcap"
    attack = Attack()
    attack.channel(RawImage, "/image")
    good = message(encode(RawImage(0, "a", 64, 64, "mono8", 64, os.urandom(4096))))
    attack.chunk(good, [(0, 0)])
    compressor = zstandard.ZstdCompressor(write_content_size=with_size)
    attack.chunk(good, [(0, 0)], packed=compressor.compress(good), size=len(good) | 1 << 33)
    path.write_bytes(attack.finish())
    report = repair(path)
    assert report.changed
    with LogReader(path) as reader:
        assert [len(one.data) for one in reader.messages()] == [len(good) - 31] * 2


def test_log_with_a_refused_chunk_still_shows_its_contents(tmp_path: Path) -> None:
    path = black_frames(tmp_path / "black.mcap", "zstd", True)
    with LogReader(path) as reader:
        assert reader.message_count == 1
        assert reader.times("/image").tolist() == [0]


def test_densest_log_that_we_write_is_read_and_whole(tmp_path: Path) -> None:
    """The log has minutes of empty frames, and parameters of one model that are all zeros."""
    path = tmp_path / "dense.mcap"
    nothing = encode(Markers(0, (), 960, 540))
    with LogWriter.create(path) as log:
        log.add_channel(
            "/runs/a/cameras/a/markers",
            Schema("ipsys.v1.Markers", "protobuf", schema_data("ipsys.v1.Markers")),
        )
        log.add_channel("/large", POINT)
        for number in range(10_000):
            log.write("/runs/a/cameras/a/markers", number * 33_000_000, 0, nothing)
        for number in range(2):
            log.write("/large", 10_000 * 33_000_000 + number, 0, bytes(20 * MIB))
    assert not repair(path).changed
    with Session([path]) as session:
        assert sum(1 for _ in session.messages(["/runs/a/cameras/a/markers"])) == 10_000
        assert [len(one.data) for one in session.readers[0].messages(["/large"])] == [20 * MIB] * 2


def test_message_larger_than_a_chunk_is_refused_when_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter.create(path) as log:
        log.add_channel("/a", POINT)
        log.write("/a", 1, 1, b"before")
        with pytest.raises(LogError, match=f"{LARGEST_MESSAGE + 1} bytes"):
            log.write("/a", 2, 2, bytes(LARGEST_MESSAGE + 1))
        log.write("/a", 3, 3, b"after")
    with LogReader(path) as reader:
        assert [one.data for one in reader.messages()] == [b"before", b"after"]
    assert LARGEST_MESSAGE < LARGEST_CHUNK
