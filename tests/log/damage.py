"""Natural damage to logs, and the messages that must survive a repair.

    python -m tests.log.damage --cases 20000 --seed 1

repairs so many damaged logs, reads each with three readers, and prints what it found.
"""

import argparse
import random
import struct
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, cast

import zstandard
from mcap import records as mcap
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

from ipsys_log.errors import LogError
from ipsys_log.log.journal import DISK, Storage
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import MAGIC, to_bytes
from ipsys_log.log.recovery import RepairReport, repair
from ipsys_log.log.writer import LogWriter
from tests.log.conftest import IMAGE, POINT, Row, as_row, linear_rows, stock_rows, write_rows

SECTOR = 512
Payload = tuple[int, int, bytes]  # log time, publish time, data
Span = tuple[int, int]


class NoSync:
    """A disk without waiting for syncs."""

    def __getattr__(self, name: str) -> Any:
        return getattr(DISK, name)

    def fsync(self, fd: int) -> None:
        pass

    def fsync_directory(self, directory: Path) -> None:
        pass


QUICK = cast(Storage, NoSync())


@dataclass(frozen=True)
class Sample:
    """A log, and for each message the record that contains it and the definitions of its channel.

    If `checked` is true, the CRC of its chunk covers each message.
    """

    name: str
    data: bytes
    messages: list[tuple[Span, int, Row]]  # record, channel id, message
    definitions: dict[int, list[Span]]  # by channel id: the records that define it, the first ones
    summary: Span | None  # the records that repeat the definitions, if any
    checked: bool
    is_readable: bool  # by the stock reader, which needs the channels in the summary
    written: frozenset[Payload]  # all written data, complete or not in the log


def sample_of(name: str, data: bytes, rows: Iterable[Row] = ()) -> Sample:
    """Split a log into records with struct and the stock reader, not with the code under test."""
    messages: list[tuple[Span, int, Row]] = []
    channels: dict[int, mcap.Channel] = {}
    schemas: dict[int, Span] = {}
    definitions: dict[int, list[Span]] = {}
    checked, summary, position = True, None, 8
    while position + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, position)
        span = (position, position + 9 + length)
        if span[1] > len(data):
            break
        inner = list(_records(data[position : span[1]], opcode))
        for record in inner:
            if isinstance(record, mcap.Schema):
                schemas.setdefault(record.id, span)
            elif isinstance(record, mcap.Channel):
                channels.setdefault(record.id, record)
                spans = [schemas[record.schema_id], span] if record.schema_id else [span]
                definitions.setdefault(record.id, spans)
            elif isinstance(record, mcap.Message):
                topic = channels[record.channel_id].topic
                row = (topic, record.log_time, record.publish_time, record.data)
                messages.append((span, record.channel_id, row))
                checked &= opcode == 6 and data[position + 33 : position + 37] != bytes(4)
        position = span[1]
        if opcode == 15:
            rest = data[position:]
            summary = (position, len(data)) if b"\x04" in rest and _repeats(rest) else None
            break
    written = frozenset(row[1:] for row in (*rows, *(row for _, _, row in messages)))
    is_readable = name != "no definitions in summary"
    return Sample(name, data, messages, definitions, summary, checked, is_readable, written)


def _records(data: bytes, opcode: int) -> Iterator[mcap.McapRecord]:
    if opcode == 6:
        chunk = next(iter(StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records))
        yield from breakup_chunk(cast(mcap.Chunk, chunk))
    elif opcode in (3, 4, 5):
        yield next(iter(StreamReader(BytesIO(data), skip_magic=True).records))


def _repeats(rest: bytes) -> bool:
    """Return whether a summary defines channels, counts messages, and has a CRC."""
    opcodes, position = set(), 0
    while position + 9 <= len(rest) - 8:
        opcode, length = struct.unpack_from("<BQ", rest, position)
        opcodes.add(opcode)
        position += 9 + length
    return {4, 11} <= opcodes and rest[-12:-8] != bytes(4)


def own_rows(chance: random.Random, seconds: int) -> list[Row]:
    out: list[Row] = []
    start = 1_700_000_000_000_000_000
    for k in range(seconds * 4):
        now = start + k * 250_000_000
        for camera in range(2):
            out.append(
                (f"/image/{camera}", now + camera, now - 5, chance.randbytes(chance.randrange(200, 1500)))
            )
        out.append(("/points", now + 2, now - 5, chance.randbytes(40) + b"point" * 9))
        if k % 3 == 0:
            out.append(("/events", now + 3, now, f"event {k}".encode()))
    return out


def own_log(folder: Path, chance: random.Random, kind: str) -> Sample:
    path = folder / "own.mcap"
    rows = own_rows(chance, 3)
    with LogWriter.create(path, storage=QUICK) as writer:
        for topic in ("/image/0", "/image/1", "/points", "/events"):
            writer.add_channel(topic, IMAGE if topic.startswith("/image") else POINT)
        write_rows(writer, rows)
        writer.flush()
        killed = path.read_bytes()
    if kind == "appended":
        for run in range(2):
            with LogWriter.append(path, storage=QUICK) as writer:
                write_rows(
                    writer,
                    [(f"/runs/{run}/a", row[1], row[2], row[3][:60]) for row in rows if len(row[3]) < 900],
                )
    data = path.read_bytes() if kind != "killed" else killed[: chance.randrange(300, len(killed) + 1)]
    path.unlink()
    return sample_of(kind, data, rows)


SHAPES: dict[str, dict[str, object]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "unchunked": {"use_chunking": False},
    "unchunked, data CRC": {"use_chunking": False, "enable_data_crcs": True},
    "no index": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.CHUNK},
    "no statistics": {"use_statistics": False},
    "no definitions in summary": {"repeat_channels": False, "repeat_schemas": False},
    "no CRC": {"enable_crcs": False, "compression": CompressionType.NONE},
    "no CRC, zstd": {"enable_crcs": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    },
}


def foreign_log(folder: Path, chance: random.Random, shape: str) -> bytes:
    path = folder / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chance.choice((900, 3000, 20_000)), **SHAPES[shape])  # type: ignore
        writer.start()
        ids = []
        for number, topic in enumerate(("/a", "/b", "/long/topic/of/another/program", "/b")):
            schema = writer.register_schema(f"Thing{min(number, 2)}", "jsonschema", b"{}" * (1 + 40 * number))
            ids.append(writer.register_channel(topic, "json", schema if number < 3 else 2))
        if chance.random() < 0.5:
            writer.add_attachment(1, 2, "notes.txt", "text/plain", b"hello" * chance.randrange(1, 300))
        for number in range(90):
            now = 1_700_000_000_000_000_000 + number * 10_000_000 - number % 3 * 25_000_000
            data = f'{{"number": {number}, "text": "{chance.random()}"}}'.encode()
            data += chance.randbytes(chance.choice((0, 60, 400)))
            writer.add_message(chance.choice(ids), now, data, now - 5, number)
        writer.add_metadata("robot", {"name": "seven"})
        writer.finish()  # type: ignore[no-untyped-call]
    data = path.read_bytes()
    path.unlink()
    return data


def repeated_log(chance: random.Random) -> bytes:
    """Return a log with the definitions in every chunk; half of the time without its last records."""
    schema = mcap.Schema(1, b"{}", "jsonschema", "Thing")
    channels = [mcap.Channel(key, topic, "json", {}, 1) for key, topic in ((1, "/a"), (7, "/b"))]
    out = MAGIC + to_bytes(mcap.Header("", "other"))
    for number in range(8):
        now = 1_700_000_000_000_000_000 + number * 10**9
        records = [schema, *channels]
        entries: dict[int, list[tuple[int, int]]] = {1: [], 7: []}
        data = to_bytes(*records)
        for k in range(12):
            key = chance.choice((1, 7))
            entries[key].append((now + k, len(data)))
            data += to_bytes(mcap.Message(key, now + k, chance.randbytes(60), now, k))
        packed = zstandard.ZstdCompressor().compress(data)
        out += to_bytes(mcap.Chunk("zstd", packed, now + 11, now, zlib.crc32(data), len(data)))
        for key, rows in entries.items():
            if rows:
                out += to_bytes(mcap.MessageIndex(key, rows))
    if chance.random() < 0.5:
        out += to_bytes(mcap.DataEnd(0), mcap.Footer(0, 0, 0)) + MAGIC
    return out


def samples(seed: int) -> list[Sample]:
    """Return logs of every kind; another seed gives others."""
    chance = random.Random(seed)
    made: list[Sample] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind in ("live", "appended", "killed"):
            made.append(own_log(folder, chance, kind))
        for shape in SHAPES:
            made.append(sample_of(shape, foreign_log(folder, chance, shape)))
    made.append(sample_of("repeated definitions", repeated_log(chance)))
    return made


@dataclass
class Damaged:
    """A damaged log, its damage, and its changed bytes."""

    data: bytearray
    done: list[str] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)

    def touches(self, span: Span) -> bool:
        return any(low < span[1] and span[0] < high for low, high in self.spans)

    def put(self, what: str, at: int, new: bytes) -> None:
        old = self.data[at : at + len(new)]
        self.done.append(f"{what} at {at}")
        if old != new:
            changed = [k for k in range(len(old)) if old[k] != new[k]]
            self.spans.append((at + changed[0], at + changed[-1] + 1))
        self.data[at : at + len(old)] = new[: len(old)]


def damage(sample: Sample, chance: random.Random, times: int, other: bytes) -> Damaged:
    """Damage a log as disks, memory and power cuts do."""
    out = Damaged(bytearray(sample.data))
    for _ in range(times):
        size = len(out.data)
        sectors = -(-size // SECTOR)
        sector = chance.randrange(sectors) * SECTOR
        kind = chance.choice(("zeroed", "duplicated", "swapped in", "flipped", "flipped", "cut"))
        if kind == "zeroed":
            out.put(kind, sector, bytes(min(SECTOR, size - sector)))
        elif kind == "duplicated":
            source = chance.randrange(sectors) * SECTOR
            out.put(f"{kind} {source}", sector, bytes(out.data[source : source + min(SECTOR, size - sector)]))
        elif kind == "swapped in":
            source = chance.randrange(max(1, len(other) // SECTOR)) * SECTOR
            out.put(kind, sector, other[source : source + min(SECTOR, size - sector)])
        elif kind == "flipped":
            at = chance.randrange(size)
            out.put(kind, at, bytes([out.data[at] ^ 1 << chance.randrange(8)]))
        elif size > 64:
            at = chance.randrange(9, size)
            out.done.append(f"cut at {at}")
            out.spans.append((at, 1 << 62))
            del out.data[at:]
    return out


@dataclass
class Outcome:
    """The result of one repair. `complaints` is empty if the result is correct."""

    complaints: list[str] = field(default_factory=list)
    refused: str = ""
    changed: bool = False
    kept: int = 0
    owed: int = 0
    beyond: int = 0  # messages of damaged records that were saved
    invented: int = 0  # messages that were never written, saved without a CRC
    report: RepairReport | None = None


def check(path: Path, sample: Sample, damaged: Damaged, other: Sample) -> Outcome:
    """Repair a damaged log and read it with three readers; it may contain sectors of `other`."""
    for old in path.parent.iterdir():
        old.unlink()
    path.write_bytes(damaged.data)
    out = Outcome()
    owed = Counter(row[1:] for span, _, row in sample.messages if not damaged.touches(span))
    out.owed = owed.total()
    try:
        out.report = repair(path, storage=QUICK)
    except LogError as error:
        out.refused = str(error).replace(str(path), "log")
        if path.read_bytes() != damaged.data or [*path.parent.iterdir()] != [path]:
            out.complaints.append("a refused log was changed")
        if owed or "was not changed. Keep a copy" in out.refused:
            out.complaints.append(f"refused: {out.refused}")
        return out
    out.changed = out.report.changed
    if out.changed or sample.is_readable:
        _check_readers(path, sample, damaged, other, owed, out)
    _check_restored(path, bytes(damaged.data), out)
    files = {file: file.read_bytes() for file in path.parent.iterdir()}
    again = repair(path, storage=QUICK)
    if again.changed or {file: file.read_bytes() for file in path.parent.iterdir()} != files:
        out.complaints.append(f"a second repair changes it: {again.notes}")
    return out


def _check_readers(
    path: Path, sample: Sample, damaged: Damaged, other: Sample, owed: Counter[Payload], out: Outcome
) -> None:
    assert out.report is not None
    try:
        indexed, streamed = sorted(stock_rows(path)), sorted(linear_rows(path))
        plain = sorted(non_seeking_rows(path))
        with LogReader(path) as reader:
            count = reader.message_count
            ours = sorted(as_row(m) for m in reader.messages())
    except Exception as error:  # any exception would reach the user
        out.complaints.append(f"reading fails: {error!r}")
        return
    out.kept = len(indexed)
    if not indexed == streamed == plain == ours:
        out.complaints.append(f"readers differ: {len(indexed)}, {len(streamed)}, {len(plain)}, {len(ours)}")
    if not count == out.kept == out.report.messages_kept:
        out.complaints.append(f"counts differ: {count}, {out.kept}, {out.report.messages_kept}")
    got = Counter(row[1:] for row in indexed)
    missing = owed - got
    if missing:
        out.complaints.append(f"{missing.total()} messages of undamaged records are gone")
    _check_topics(sample, damaged, Counter(indexed), out)
    strange = sum(number for row, number in got.items() if row not in sample.written | other.written)
    out.beyond = len(indexed) - out.owed
    if strange and sample.checked:
        out.invented = strange
        # Without beginning and end, it is unknown whether the messages were in chunks with CRCs.
        ends = sample.summary is not None and not damaged.touches(sample.summary)
        known = ends or not damaged.touches((0, 2 * SECTOR))
        if not out.report.unchecked and known:
            out.complaints.append(f"{strange} messages were never written")


def _check_topics(sample: Sample, damaged: Damaged, got: Counter[Row], out: Outcome) -> None:
    """Messages have their own topics if the definitions are undamaged somewhere."""
    summary = sample.summary is not None and not damaged.touches(sample.summary)
    for span, channel, row in sample.messages:
        defined = summary or not any(damaged.touches(at) for at in sample.definitions[channel])
        if defined and not damaged.touches(span) and not got[row]:
            out.complaints.append(f"a message lost its topic {row[0]}")
            return


def non_seeking_rows(path: Path) -> list[Row]:
    """Read a stream that cannot seek. The reader needs definitions before messages."""
    from mcap.reader import NonSeekingReader

    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        return [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in reader.iter_messages()]


def _check_restored(path: Path, damaged: bytes, out: Outcome) -> None:
    """Check that the old log is kept, or that its beginning is unchanged and its old end is kept."""
    assert out.report is not None
    kept = out.report.damaged_file.read_bytes() if out.report.damaged_file is not None else b""
    beginning = path.read_bytes()[: len(damaged) - len(kept)]
    if beginning + kept != damaged:
        out.complaints.append("the old bytes are not all kept")


def cases(seed: int) -> Iterator[tuple[Sample, Damaged, Sample]]:
    """Yield logs, their damaged versions, and the log whose sectors may be in them, without end."""
    chance = random.Random(seed)
    while True:
        pool = samples(chance.randrange(1 << 30))
        for _ in range(400):
            sample, other = chance.choice(pool), chance.choice(pool)
            yield sample, damage(sample, chance, chance.choice((1, 1, 2)), other.data), other


def run(seed: int, number: int, show: Callable[[str], None] = lambda _: None) -> Counter[str]:
    """Repair `number` damaged logs; the totals, with every complaint under "complaints"."""
    totals: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        path = Path(name) / "log.mcap"
        for case, (sample, damaged, other) in enumerate(islice(cases(seed), number)):
            out = check(path, sample, damaged, other)
            totals += Counter(
                cases=1, changed=out.changed, refused=bool(out.refused), owed=out.owed, kept=out.kept,
                invented=out.invented, complaints=bool(out.complaints), damaged_records=max(0, out.beyond),
                unchecked=out.report.unchecked if out.report else 0,
                written=len(sample.messages),
            )  # fmt: skip
            for complaint in out.complaints:
                show(f"seed {seed} case {case} ({sample.name}, {', '.join(damaged.done)}): {complaint}")
    return totals


def main() -> int:
    parser = argparse.ArgumentParser(description="Repair damaged logs, and read each with three readers.")
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    start = time.monotonic()
    totals = run(options.seed, options.cases, lambda line: print(line, flush=True))  # noqa: T201
    print(dict(totals), f"{time.monotonic() - start:.0f} s")  # noqa: T201
    return 1 if totals["complaints"] else 0


if __name__ == "__main__":
    sys.exit(main())
