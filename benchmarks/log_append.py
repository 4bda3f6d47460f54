"""Time to append the results of three stages to a log of images.

    python benchmarks/log_append.py --gb 1

Three appends of 9 channels and 10,000 small messages each. Only the work of the log counts: opening for
append, writing, closing (journal, truncate, fsync). The script prints JSON; it fails if the recorded data
changed.
"""

import argparse
import hashlib
import json
import random
import sys
import tempfile
import time
from pathlib import Path

from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter

IMAGE_BYTES = 300_000
CHANNELS = 9
MESSAGES = 10_000
PERIOD_NS = 33_333_333


def record(path: Path, gigabytes: float) -> None:
    chance = random.Random(1)
    with LogWriter.create(path) as writer:
        writer.add_channel("/cameras/a/image", Schema("foxglove.CompressedImage", "protobuf", b""))
        for number in range(int(gigabytes * 1e9 / IMAGE_BYTES)):
            now = number * PERIOD_NS
            writer.write("/cameras/a/image", now, now, chance.randbytes(IMAGE_BYTES))


def append_stage(path: Path, stage: int) -> float:
    """Return the seconds of log work for one stage."""
    chance = random.Random(stage)
    schema = Schema("ipsys.v1.Markers", "protobuf", bytes(5_000))
    rows = [
        (f"/runs/{stage}/{k % CHANNELS}", k // CHANNELS * PERIOD_NS, chance.randbytes(120))
        for k in range(MESSAGES)
    ]
    begin = time.perf_counter()
    with LogWriter.append(path) as writer:
        for channel in range(CHANNELS):
            writer.add_channel(f"/runs/{stage}/{channel}", schema)
        for topic, now, data in rows:
            writer.write(topic, now, now, data)
    return time.perf_counter() - begin


def digest(path: Path, size: int) -> str:
    state = hashlib.blake2b()
    with path.open("rb") as file:
        while size and (block := file.read(min(size, 1 << 20))):
            state.update(block)
            size -= len(block)
    return state.hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gb", type=float, default=1.0, help="size of the recorded log")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        record(path, options.gb)
        with LogReader(path) as reader:
            end = reader.data_end
        before = digest(path, end)
        seconds = [append_stage(path, stage) for stage in range(3)]
        unchanged = digest(path, end) == before
        with LogReader(path) as reader:
            count = sum(1 for _ in reader.messages([t for t in reader.channels if t.startswith("/runs/")]))
    result = {
        "append_s": sum(seconds),
        "each_s": seconds,
        "data_section_unchanged": unchanged,
        "messages": count,
    }
    json.dump({**result, "gb": options.gb}, sys.stdout, indent=2)
    print()
    if not unchanged or count != 3 * MESSAGES:
        raise SystemExit("the recorded data changed, or messages are missing")


if __name__ == "__main__":
    main()
