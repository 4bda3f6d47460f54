"""Requests and bytes to read a log in an S3 server on loopback, beside ``mcap`` through the same s3fs.

    python benchmarks/remote.py --mb 1000

The log has the images of a sample log, repeated and filled up to 600 kB each, with all results up to the
tracks. The server (moto) counts the requests that it answers, HEAD requests too, and the bytes of its
answers. Each command runs in a process of its own, so that it knows nothing of the log. Speed is not
measured: this server reads the whole object for each request.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from results import Report, command
from rounds import Row
from scenes import CACHE

import ipsys_log as ipsys
from ipsys_log.log.codec import encode, schema_data, schema_name
from ipsys_log.log.contents import Schema
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import CompressedImage, Message

SAMPLE = Path(__file__).resolve().parent.parent / "sample_logs" / "small_lab.mcap"
IMAGE_BYTES = 600_000
PERIOD_NS = 33_000_000
LARGEST_SHARE, MOST_REQUESTS = 0.5, 40  # in % of the log; for logs of up to 60 chunks of small messages

COMMANDS = {
    "info": ["info", "{url}", "--json"],
    "evaluate": ["evaluate", "{url}", "--model", "poly", "--json"],
    "report": ["report", "{url}", "--model", "poly", "--html", "{folder}/lab.html"],
}
TABLE = "import ipsys_log, sys; print(len(ipsys_log.open(sys.argv[1]).table('tracks')))"
STOCK = """
import sys
from fsspec.core import open as open_url
from mcap.reader import make_reader
with open_url(sys.argv[1], "rb") as file:
    reader = make_reader(file)
    summary, topics = reader.get_summary(), sys.argv[2:]
    print(sum(1 for _ in reader.iter_messages(topics=topics)) if topics else summary)
"""


@dataclass(slots=True)
class Counts:
    """The requests that a server has answered, and the bytes of its answers."""

    requests: int = 0
    answered_bytes: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, requests: int, answered_bytes: int) -> None:
        with self.lock:
            self.requests += requests
            self.answered_bytes += answered_bytes

    def take(self) -> tuple[int, int]:
        """Return the counts since the last call."""
        with self.lock:
            taken = self.requests, self.answered_bytes
            self.requests = self.answered_bytes = 0
        return taken


@contextmanager
def serve_s3(counts: Counts) -> Iterator[str]:
    """Yield the address of an S3 server on loopback."""
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, *_: object) -> None: ...

    store = DomainDispatcherApplication(create_backend_app)

    def application(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        counts.add(1, 0)
        for piece in store(environ, start_response):
            counts.add(0, len(piece))
            yield piece

    server = make_server("127.0.0.1", 0, application, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()


def make_log(path: Path, megabytes: float) -> None:
    """Write a log with images of `megabytes`, and compute its runs."""
    with Session([SAMPLE]) as session, LogWriter.create(path, atomic=True) as writer:
        topics = sorted({topic for reader in session.readers for topic in reader.channels})
        count = sum(session.count(topic) for topic in session.images.values())
        repeats = max(1, round(megabytes * 1e6 / IMAGE_BYTES / count))
        for topic in topics:
            (message,) = [next(session.messages([topic]))]
            name = schema_name(type(message.payload))
            writer.add_channel(topic, Schema(name, "protobuf", schema_data(name)))
        rows = sorted(
            (row for message in session.messages(topics) for row in _repeated(message, repeats)),
            key=lambda row: row.log_time_ns,
        )
        for row in rows:
            writer.write(row.topic, row.log_time_ns, row.publish_time_ns, encode(row.payload))
    ipsys.replay(path, models=["poly"])


def _repeated(message: Message, repeats: int) -> Iterator[Message]:
    image = message.payload
    if not isinstance(image, CompressedImage):
        yield message
        return
    filled = image.data + bytes(max(0, IMAGE_BYTES - len(image.data)))
    for number in range(repeats):
        shift_ns = number * PERIOD_NS
        payload = replace(image, timestamp=image.timestamp + shift_ns, data=filled)
        yield replace(
            message,
            log_time_ns=message.log_time_ns + shift_ns,
            publish_time_ns=message.publish_time_ns + shift_ns,
            payload=payload,
        )


def _run(arguments: list[str], address: str, folder: Path) -> str:
    environment = {
        **os.environ,
        **dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "benchmark"),
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": address,
    }
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments[:4])} ended with {done.returncode}: {done.stderr[-500:]}")
    return done.stdout


def _upload(path: Path, address: str) -> None:
    import boto3

    keys = dict.fromkeys(("aws_access_key_id", "aws_secret_access_key"), "benchmark")
    client = boto3.client("s3", endpoint_url=address, region_name="us-east-1", **keys)
    client.create_bucket(Bucket="logs")
    with path.open("rb") as file:
        client.put_object(Bucket="logs", Key="lab.mcap", Body=file)


def measure(options: argparse.Namespace) -> Report:
    """Count the requests and bytes of each command, and of the stock reader."""
    report = Report("remote")
    megabytes = 10.0 if options.smoke else options.mb
    path = CACHE / f"remote_{megabytes:g}.mcap"
    CACHE.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        make_log(path, megabytes)
    size, url, counts = path.stat().st_size, "s3://logs/lab.mcap", Counts()
    with Session([path]) as session:
        (reader,) = session.readers
        report.details["log"] = {
            "bytes": size,
            "chunks": reader.chunk_count,
            "compressions": dict(reader.compressions),
        }
    programs = {
        name: ["-m", "ipsys_log", *(word.format(url=url, folder=CACHE) for word in words)]
        for name, words in COMMANDS.items()
    }
    programs["log.table"] = ["-c", TABLE, url]
    programs["mcap, summary"] = ["-c", STOCK, url]
    programs["mcap, tracks"] = ["-c", STOCK, url, "/runs/poly/tracks"]
    with serve_s3(counts) as address:
        _upload(path, address)
        for name, program in programs.items():
            counts.take()
            _run(program, address, CACHE)
            requests, answered = counts.take()
            _add_rows(report, name, requests, 100 * answered / size)
            report.details[name] = {"requests": requests, "bytes": answered}
    return report


def _add_rows(report: Report, name: str, requests: int, share: float) -> None:
    is_own = not name.startswith("mcap")
    report.rows.append(Row(name, (requests,), "requests", ("<=", MOST_REQUESTS) if is_own else None))
    report.rows.append(Row(name, (share,), "% of bytes", ("<=", LARGEST_SHARE) if is_own else None))


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--mb", type=float, default=1000.0, help="size of the log in a store")


if __name__ == "__main__":
    command("remote")
