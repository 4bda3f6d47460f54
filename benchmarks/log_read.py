"""How fast small messages that lie among images are read, against the stock reader in the same run.

    python benchmarks/log_read.py --gb 1

prints JSON, ratios first. The foreign log is written by ``mcap.Writer``; images are random bytes of
300 kB, as incompressible as JPEG. Both readers run in turns; the files are in the page cache.
"""

import argparse
import json
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from ipsys_log.log import LogReader, LogWriter, Schema

IMAGE_BYTES = 300_000
SMALL = 3_000
PERIOD_NS = 33_333_333


def payloads(gigabytes: float) -> tuple[int, list[bytes]]:
    """Number of images, and small payloads of about 100 bytes."""
    chance = random.Random(1)
    return int(gigabytes * 1e9 / IMAGE_BYTES), [chance.randbytes(90 + k % 20) for k in range(SMALL)]


def write_foreign(path: Path, gigabytes: float, compression: CompressionType) -> None:
    images, small = payloads(gigabytes)
    chance = random.Random(2)
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "protobuf", b"")
        image = writer.register_channel("/image", "protobuf", schema)
        points = writer.register_channel("/points", "protobuf", writer.register_schema("P", "protobuf", b""))
        sent = 0
        for number in range(images):
            now = number * PERIOD_NS
            writer.add_message(image, now, chance.randbytes(IMAGE_BYTES), now)
            while sent < (number + 1) * SMALL // images:
                writer.add_message(points, now + 1 + sent % 7, small[sent], now)
                sent += 1
        writer.finish()  # type: ignore[no-untyped-call]


def write_own(path: Path, gigabytes: float) -> None:
    images, small = payloads(gigabytes)
    chance = random.Random(2)
    with LogWriter.create(path) as writer:
        writer.add_channel("/image", Schema("foxglove.CompressedImage", "protobuf", b""))
        writer.add_channel("/points", Schema("P", "protobuf", b""))
        sent = 0
        for number in range(images):
            now = number * PERIOD_NS
            writer.write("/image", now, now, chance.randbytes(IMAGE_BYTES))
            while sent < (number + 1) * SMALL // images:
                writer.write("/points", now + 1 + sent % 7, now, small[sent])
                sent += 1


def read_stock(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        return [message.data for _, _, message in make_reader(file).iter_messages(topics=["/points"])]


def read_ours(path: Path) -> list[bytes]:
    with LogReader(path) as reader:
        return [message.data for message in reader.messages(["/points"])]


def best(read: Callable[[Path], list[bytes]], path: Path, times: list[float]) -> list[bytes]:
    start = time.perf_counter()
    out = read(path)
    times.append(time.perf_counter() - start)
    return out


def compare(path: Path, rounds: int) -> tuple[float, dict[str, float]]:
    """Ratio of the best times, stock to ours, over alternating rounds; the results must be equal."""
    stock: list[float] = []
    ours: list[float] = []
    read_ours(path)  # both find the file in the page cache
    for _ in range(rounds):
        if best(read_stock, path, stock) != best(read_ours, path, ours):
            raise SystemExit(f"{path}: the readers differ")
    return min(stock) / min(ours), {"stock_s": min(stock), "ours_s": min(ours)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gb", type=float, default=1.0, help="size of each log")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    ratios: dict[str, float] = {}
    detail: dict[str, object] = {"gb": options.gb}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        for name in ("NONE", "ZSTD", "LZ4"):
            write_foreign(path, options.gb, CompressionType[name])
            ratios[f"foreign_{name}"], detail[name] = compare(path, options.rounds)
            path.unlink()
        write_own(path, options.gb)
        ratios["own"], detail["own"] = compare(path, options.rounds)
        with LogReader(path) as reader:
            count = len(list(reader.messages(["/points"])))
            ratios["own_bytes_read_fraction"] = reader.bytes_read / path.stat().st_size
    json.dump({"ratios": ratios, "messages": count, **detail}, sys.stdout, indent=2)
    print()


if __name__ == "__main__":
    main()
