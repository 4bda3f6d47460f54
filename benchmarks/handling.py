"""Speed of the commands that copy or check whole logs, relative to ``cp``; and their memory.

    python benchmarks/handling.py
    python benchmarks/handling.py --handling-gb 5 --rounds 1

Two logs of cameras have the same times, with images of 300 kB (random bytes, which no program can compress)
and small messages. In turns, ``cp`` copies them, and ipsys cuts, compacts, merges and checks them, and saves
a recording for Rerun (``view``), each in a new process. Each turn begins with the logs out of the page cache,
and ends when the new file is on the disk. Ratios are wall time for each written (or checked) byte. ``crc`` is
the time of the CRC-32 of as many bytes. Memory is RssAnon of the process at most, read every 10 ms.

``view`` also saves a session of the simulated lab with all its runs, half as large as the other log.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import tempfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event, Thread

from results import Report, command
from rounds import Contender, Row, Timing, Turn, race
from scenes import CACHE, drawn, lengthened

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.request import Request
from ipsys_log.engine.workers import available_cores
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.codec import encode, schema_data
from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import CompressedImage

__all__ = ["Memory", "measure"]

IMAGE_BYTES = 300_000
PERIOD_NS = 33_333_333
_EPOCH_NS = 1_700_000_000_000_000_000
_CAMERAS = (("red", "white"), ("black",))
_EVERY_S = 0.01
_JPEG_START = b"\xff\xd8\xff"
_KEPT = (0.1, 0.9)  # of the time, in the cut

# Makes a new file of logs.
Verb = Callable[[Sequence[Path], Path], None]


def _record(path: Path, cameras: Sequence[str], instants: int) -> None:
    chance = random.Random(len(cameras))
    # Viewers refuse an image that does not begin as a JPEG.
    images = [_JPEG_START + chance.randbytes(IMAGE_BYTES - len(_JPEG_START)) for _ in range(30)]
    with LogWriter.create(path) as writer:
        for camera in cameras:
            schema = Schema("foxglove.CompressedImage", "protobuf", schema_data("foxglove.CompressedImage"))
            writer.add_channel(f"/cameras/{camera}/image", schema)
        writer.add_channel(f"/{cameras[0]}/small", None, "json")
        for number in range(instants):
            now = _EPOCH_NS + number * PERIOD_NS
            for camera in cameras:
                image = CompressedImage(now, camera, images[chance.randrange(len(images))], "jpeg")
                writer.write(f"/cameras/{camera}/image", now, now, encode(image))
            writer.write(f"/{cameras[0]}/small", now, now, b'{"number": %d}' % number)


def _session(path: Path, size: float, is_smoke: bool) -> None:
    """Write a session of the simulated lab of about ``size`` bytes, with the runs of all stages."""
    width, height = (640, 360) if is_smoke else (1920, 1080)
    base = drawn(LabSettings(width=width, height=height, stations=16, drive_s=0.5 if is_smoke else 10.0))
    with LogReader(base) as reader:
        images = (topic for topic in reader.channels if topic.endswith("/image"))
        frames = sum(reader.channels[topic].message_count for topic in images)
    lengthened(base, path, frames if is_smoke else round(frames * size / base.stat().st_size))
    replay([path], Request(), jobs=available_cores())


def _cp(logs: Sequence[Path], copy: Path) -> None:
    subprocess.run(["cp", "--reflink=never", str(logs[0]), str(copy)], check=True)
    with copy.open("rb") as file:
        os.fsync(file.fileno())


def _crc(logs: Sequence[Path], _copy: Path) -> None:
    piece = bytes(4 << 20)
    for _ in range(logs[0].stat().st_size // len(piece) + 1):
        zlib.crc32(piece)


def _cut(logs: Sequence[Path], part: Path) -> None:
    from ipsys_log.tools.cut import cut
    from ipsys_log.tools.cut_selection import CutOptions

    with LogReader(logs[0]) as reader:
        start_ns, end_ns = reader.start_ns or 0, reader.end_ns or 0
    start, end = (f"{share * (end_ns - start_ns) / 1e9:.3f}" for share in _KEPT)
    cut([logs[0]], part, CutOptions(start=start, end=end))


def _compact(logs: Sequence[Path], copy: Path) -> None:
    from ipsys_log.tools.cut import compact

    compact(logs[0], copy)


def _merge(logs: Sequence[Path], merged: Path) -> None:
    from ipsys_log.tools.merge import merge
    from ipsys_log.tools.merge_plan import LogOffset

    merge(logs, merged, [LogOffset() for _ in logs])


def _view(logs: Sequence[Path], recording: Path) -> None:
    from ipsys_log.log.dataset import Session
    from ipsys_log.sinks.rerun.recording import write_recording

    with Session([logs[0]]) as session:
        write_recording(session, save=recording)
    with recording.open("rb") as file:
        os.fsync(file.fileno())


def _check(logs: Sequence[Path], _copy: Path) -> None:
    from ipsys_log.tools.soundness.check import check_logs

    check_logs([logs[0]], lambda _stage, _done, _total: None)


_VERBS: dict[str, Verb] = {
    "cp": _cp, "crc": _crc, "cut": _cut, "compact": _compact, "merge": _merge, "check": _check, "view": _view
}  # fmt: skip


def _turn(name: str, logs: Sequence[Path], output: Path) -> Turn:
    verb = _VERBS[name]

    def turn(_number: int) -> tuple[int, float]:
        output.unlink(missing_ok=True)
        for log in logs:
            with log.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        with Memory() as memory:
            verb(logs, output)
        size = output.stat().st_size if output.exists() else logs[0].stat().st_size
        output.unlink(missing_ok=True)
        return size, memory.most_mb

    return turn


class Memory:
    """The anonymous memory of this process at most, in MB, while the block runs."""

    def __init__(self) -> None:
        self.most_mb, self._ended = 0.0, Event()
        self._thread = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Memory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
                if line.startswith("RssAnon"):
                    self.most_mb = max(self.most_mb, int(line.split()[1]) / 1000)
            if self._ended.wait(_EVERY_S):
                return


def measure(options: argparse.Namespace) -> Report:
    """Copy, cut, compact, merge, check and view the logs in turns."""
    report = Report("handling")
    instants = 40 if options.smoke else round(options.handling_gb * 1e9 / (2 * IMAGE_BYTES))
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        logs = [Path(folder) / f"{'_'.join(cameras)}.mcap" for cameras in _CAMERAS]
        for path, cameras in zip(logs, _CAMERAS, strict=True):
            _record(path, cameras, instants)
        contenders = [Contender(name, _turn, (name, logs, Path(folder) / f"{name}.mcap")) for name in _VERBS]
        session = Path(folder) / "session.mcap"
        _session(session, options.handling_gb * 1e9 / 2, options.smoke)
        for name in ("cp", "view"):
            of_session = (name, [session], Path(folder) / f"{name}_session.mcap")
            contenders.append(Contender(f"{name} of a session", _turn, of_session))
        timings = race(contenders, 1, options.rounds)
        logs.append(session)
        report.remarks.append(f"logs of {', '.join(f'{log.stat().st_size / 1e9:.2f}' for log in logs)} GB")
    for name in ("cut", "compact", "merge", "check", "view"):
        limit = None if name in ("check", "view") else ("<=", 2.0)
        report.rows.append(Row(f"{name} / cp", _ratios(timings[name], timings["cp"]), wanted=limit))
    view, cp = (timings[f"{name} of a session"] for name in ("view", "cp"))
    report.rows.append(Row("view / cp, a session with all runs", _ratios(view, cp)))
    report.rows.append(Row("crc / cp", _ratios(timings["crc"], timings["cp"])))
    for name in ("cut", "compact", "merge", "check", "view"):
        report.rows.append(Row(f"{name}, anonymous memory", (timings[name].kept[0][1],), "MB", ("<=", 300.0)))
    report.rows.append(Row("cp", tuple(_s_per_gb(timings["cp"])), "s/GB"))
    report.details = {name: {"wall_s": one.wall_s, "kept": one.kept} for name, one in timings.items()}
    return report


def _s_per_gb(timing: Timing) -> list[float]:
    size = timing.kept[0][0]
    return [wall_s / size * 1e9 for wall_s in timing.wall_s]


def _ratios(over: Timing, under: Timing) -> tuple[float, ...]:
    return tuple(a / b for a, b in zip(_s_per_gb(over), _s_per_gb(under), strict=True))


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--handling-gb", type=float, default=1.0, help="size of the larger log")


if __name__ == "__main__":
    command("handling")
