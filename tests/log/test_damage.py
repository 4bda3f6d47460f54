"""Natural damage: all undamaged messages survive, three readers agree, and a second repair changes nothing.

``IPSYS_DAMAGE_CASES=20000 IPSYS_DAMAGE_SEED=3`` make the slow test longer, and other; `tests.log.damage` is
the same as a script.
"""

import os
from itertools import islice
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from ipsys_log.log.recovery import repair
from tests.log.conftest import Row, stock_rows
from tests.log.damage import cases, check, run

# Cases that longer runs found: seed, number of the case, log and damage.
HARD = [
    (71, 1795, "no CRC: swapped in at 2048"),  # indexes of another log overwrite the start of a chunk
    (72, 2305, "unchunked: swapped in at 7680"),  # and of a message, in a log without chunks
    (72, 8057, "unchunked, data CRC: cut at 2329, swapped in at 512"),
    (61, 2806, "no CRC: cut at 3916, swapped in at 512"),  # definitions of another log in an attachment
    (62, 8102, "unchunked: cut at 3264, duplicated 1536 at 512"),  # one complete message between both
    (51, 733, "appended: zeroed at 1536, swapped in at 25088"),
    (92, 7827, "no statistics: cut at 10390, swapped in at 1024"),  # a header that is half of another log's
    (92, 8604, "killed: swapped in at 14848, flipped at 11844"),  # a whole chunk of another log
    (93, 1545, "unchunked, data CRC: cut at 14735, swapped in at 13824"),  # the end of another log
    (
        101,
        3223,
        "unchunked, data CRC: duplicated 13312 at 22528, flipped at 1396",
    ),  # a channel id in a message
    (101, 6904, "repeated definitions: swapped in at 0"),  # the start of another log
    (103, 3192, "killed: swapped in at 6144"),  # a whole chunk of another log in the first one
    (103, 8041, "unchunked: cut at 1214, zeroed at 512"),  # two small messages between both
    (103, 8506, "unchunked: zeroed at 2560, duplicated 18432 at 512"),  # the first message between both
    (103, 9171, "unchunked, data CRC: duplicated 20480 at 1536, zeroed at 512"),
    (202, 9307, "no statistics: flipped at 1715, swapped in at 1024"),  # a message of a log without chunks
    (93, 2517, "no index: swapped in at 11776"),  # a chunk without CRC, half of another log's
    (8, 1719, "unchunked: swapped in at 2048, duplicated 8192 at 9728"),  # a head that ends in a true message
    (7, 1361, "lz4: swapped in at 21504"),  # compressed data with a wrong length lead over whole chunks
    (401, 879, "no index: swapped in at 0, cut at 12210"),  # the definitions of another log
    (401, 2005, "repeated definitions: swapped in at 1024"),  # messages of another log after a half index
    (501, 4772, "unchunked, data CRC: duplicated 0 at 1536, flipped at 914"),  # three messages between both
    (502, 4889, "no CRC: flipped at 4194, flipped at 375"),  # a definition with wrong lengths in a chunk
    (702, 501, "unchunked, data CRC: cut at 2726, zeroed at 512"),  # one message of a lost channel
    (703, 550, "unchunked: swapped in at 7168"),  # half an index of another log
    (803, 541, "repeated definitions: flipped at 98, flipped at 9234"),  # a schema with the id 0
]


def test_repair_after_natural_damage_converges() -> None:
    complaints: list[str] = []
    totals = run(11, 120, complaints.append)
    assert complaints == []
    assert totals["changed"] > 100


def test_repair_keeps_an_attachment_that_holds_a_log(tmp_path: Path) -> None:
    path, attached = tmp_path / "a.mcap", tmp_path / "attached.mcap"
    rows: list[Row] = [("/a", 10**18 + k, 10**18, b"data %d" % k) for k in range(20)]
    for file, attachment in ((attached, b""), (path, b"attached")):
        with file.open("wb") as out:
            writer = Writer(out, use_chunking=False)
            writer.start()
            channel = writer.register_channel("/a", "json", 0)
            if attachment:
                writer.add_attachment(1, 2, "log", "application/mcap", attached.read_bytes())
                after = out.tell()
            for _, time_ns, published_ns, data in rows:
                writer.add_message(channel, time_ns, data, published_ns)
            writer.finish()  # type: ignore[no-untyped-call]
    damaged = bytearray(path.read_bytes())
    damaged[after : after + 9] = bytes(9)  # the head of the record after the attachment
    path.write_bytes(damaged)
    assert repair(path).changed
    assert stock_rows(path) == rows[1:]
    with path.open("rb") as file_:
        [kept] = make_reader(file_).iter_attachments()
    assert kept.data == attached.read_bytes()


@pytest.mark.slow
def test_repair_after_much_damage_converges() -> None:
    complaints: list[str] = []
    run(
        int(os.environ.get("IPSYS_DAMAGE_SEED", "12")),
        int(os.environ.get("IPSYS_DAMAGE_CASES", "1000")),
        complaints.append,
    )
    assert complaints == []


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "number", "what"), HARD, ids=[what for _, _, what in HARD])
def test_repair_after_hard_damage_converges(seed: int, number: int, what: str, tmp_path: Path) -> None:
    sample, damaged, other = next(islice(cases(seed), number, None))
    assert f"{sample.name}: {', '.join(damaged.done)}" == what
    assert check(tmp_path / "log.mcap", sample, damaged, other).complaints == []
