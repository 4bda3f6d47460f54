"""Append to a log, or record one, until test_together.py kills this process."""

import itertools
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter
from tests.log.conftest import IMAGE, POINT, append
from tests.log.test_together import FIRST, PER_SESSION, session

# A chunk spans a second at most: after so many tenths of a second, one is on the disk.
_WRITTEN = 25


def append_forever(path: Path) -> None:
    with LogReader(path) as reader:
        number = (reader.message_count - len(FIRST)) // PER_SESSION
    for following in itertools.count(number):
        append(path, session(following))
        if following == number:
            print("begun", flush=True)  # noqa: T201


def record_forever(path: Path) -> None:
    with LogWriter.create(path) as writer:
        writer.add_channel("/image/a", IMAGE)
        writer.add_channel("/points", POINT)
        print("begun", flush=True)  # noqa: T201
        for number in itertools.count():
            writer.write("/image/a", number * 10**8, number, bytes([1 + number % 255]) * 300_000)
            writer.write("/points", number * 10**8, number, b"point")
            if number == _WRITTEN:
                print("written", flush=True)  # noqa: T201


if __name__ == "__main__":
    {"append": append_forever, "record": record_forever}[sys.argv[1]](Path(sys.argv[2]))
