"""Speed of a cut of a log of images, relative to cp.

    python benchmarks/log_cut.py --mb 300

The log has two cameras, frames of 300 kB and small messages. In turns, ``cp`` copies it and a cut keeps the
middle four fifths, each in a new process. The result is wall time and CPU time (user and system) for each
written byte. The script prints JSON; it fails if the part has other messages than the range.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter

IMAGE_BYTES = 300_000
PERIOD_NS = 33_333_333
_CUT = """
import sys
from pathlib import Path
from ipsys_log.runs.cut import cut
from ipsys_log.runs.cut_selection import CutOptions
log, part, start, end = sys.argv[1:]
begin = __import__("time").perf_counter(), sum(__import__("os").times()[:2])
cut([Path(log)], Path(part), CutOptions(start=start, end=end))
print(__import__("time").perf_counter() - begin[0], sum(__import__("os").times()[:2]) - begin[1])
"""


def record(path: Path, megabytes: int) -> int:
    """Write the log; return its number of instants."""
    chance = random.Random(1)
    count = megabytes * 1_000_000 // (2 * IMAGE_BYTES)
    with LogWriter.create(path) as writer:
        for camera in ("red", "white"):
            writer.add_channel(
                f"/cameras/{camera}/image", Schema("foxglove.CompressedImage", "protobuf", b"")
            )
        writer.add_channel("/small", Schema("Small", "protobuf", b""))
        for number in range(count):
            now = number * PERIOD_NS
            for camera in ("red", "white"):
                writer.write(f"/cameras/{camera}/image", now, now, chance.randbytes(IMAGE_BYTES))
            writer.write("/small", now, now, chance.randbytes(100))
    return count


def time_cp(log: Path, copy: Path) -> tuple[float, float]:
    """Return wall time and CPU time of a copy in s; the copy is on the disk, as a cut is."""
    before, begin = os.times(), time.perf_counter()
    subprocess.run(["cp", "--reflink=never", str(log), str(copy)], check=True)
    with copy.open("rb") as file:
        os.fsync(file.fileno())
    after = os.times()
    return time.perf_counter() - begin, sum(after[:4]) - sum(before[:4])


def time_cut(log: Path, part: Path, start: str, end: str) -> tuple[float, float]:
    """Return wall time and CPU time of a cut in s, without the start of Python."""
    command = [sys.executable, "-c", _CUT, str(log), str(part), start, end]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    wall_s, cpu_s = map(float, done.stdout.split())
    return wall_s, cpu_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mb", type=int, default=300, help="size of the log")
    parser.add_argument("--turns", type=int, default=5)
    options = parser.parse_args()
    rows: dict[str, list[float]] = {name: [] for name in ("cp_wall", "cp_cpu", "cut_wall", "cut_cpu")}
    with tempfile.TemporaryDirectory() as folder:
        log, copy, part = (Path(folder) / name for name in ("log.mcap", "copy.mcap", "part.mcap"))
        count = record(log, options.mb)
        start, end = (f"{share * count * PERIOD_NS / 1e9:.3f}" for share in (0.1, 0.9))
        for _ in range(options.turns):
            times = *time_cp(log, copy), *time_cut(log, part, start, end)
            sizes = log.stat().st_size, part.stat().st_size
            for name, seconds, size in zip(
                rows, times, (sizes[0], sizes[0], sizes[1], sizes[1]), strict=True
            ):
                rows[name].append(seconds / size * 1e9)
            with LogReader(part) as reader:
                kept = [reader.channels[topic].message_count for topic in sorted(reader.channels)[:2]]
            copy.unlink()
            part.unlink()
    # Other programs on the machine only add time: the least of all turns is the best estimate.
    least = {f"{name}_s_per_gb": min(values) for name, values in rows.items()}
    ratios = {
        f"{kind}_ratio": least[f"cut_{kind}_s_per_gb"] / least[f"cp_{kind}_s_per_gb"]
        for kind in ("wall", "cpu")
    }
    json.dump({**ratios, **least, "mb": options.mb}, sys.stdout, indent=2)
    print()
    if any(abs(number - 0.8 * count) > 2 for number in kept):
        raise SystemExit("the part has other messages than the range")


if __name__ == "__main__":
    main()
