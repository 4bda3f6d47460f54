"""Cost of the dashboard: 20 robots, three cameras, and 30 updates a second, for one page and for ten.

    python benchmarks/dashboard.py

The messages are those of ``ipsys live``: 30 times a second three frames of 1920 x 1080 with 20 markers each,
tracks of 20 robots, and latencies. They reach the dashboard through the queue of a sink. The pages are in a
process of their own and read everything. The share of a core is the processor time of the sink and of the
server, divided by the time. It does not count while another process has the core.

The frames of the page are those that a headless Chromium draws without a GPU, with all camera images. The
browser draws on the same cores as the server.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import simplejpeg
from results import Report, command
from rounds import Row

from ipsys_log.app.web.dashboard.app import build_dashboard
from ipsys_log.app.web.dashboard.operator import Operator
from ipsys_log.app.web.dashboard.state import Dashboard, DashboardSetting
from ipsys_log.app.web.server import serve_app
from ipsys_log.capture.frames import CameraState
from ipsys_log.messages import (
    LATENCY_TOPIC,
    CompressedImage,
    Floor,
    Latency,
    Marker,
    Markers,
    Message,
    Rig,
    RigMarker,
    Track,
    Tracks,
    image_topic,
)
from ipsys_log.sinks.sink import FanOut

__all__ = ["measure"]

_ROOT = Path(__file__).resolve().parent.parent

_ROBOTS, _RATE_HZ, _CAMERAS = 20, 30, ("red", "white", "black")
_SIZE_PX = 1920, 1080
_SMOKE_S = 1.0
_NS_PER_MS = 1_000_000

# A page: it reads the stream, and asks for each new picture if it shows images.
_PAGES = """
import http.client, json, sys, threading
host, port, count, images = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "images"
updates = [0] * count
def read(n):
    source = (f"127.0.0.{2 + n}", 0)
    loading = http.client.HTTPConnection(host, port, source_address=source)
    while True:
        page = http.client.HTTPConnection(host, port, source_address=source)
        page.request("GET", "/api/live")
        for line in page.getresponse():
            updates[n] += line.startswith(b"event: robots")
            if images and b'"picture"' in line:
                for tile in json.loads(line[6:])["cameras"]:
                    if "picture" in tile:
                        loading.request("GET", "/" + tile["picture"])
                        loading.getresponse().read()
for n in range(count):
    threading.Thread(target=read, args=(n,), daemon=True).start()
print("ready", flush=True)
sys.stdin.readline()
print(min(updates, default=0), flush=True)
"""

# The frames per second that a browser draws in a page.
_FRAMES = """(async () => {{
  let frames = 0, ends = false;
  const count = () => {{ frames += 1; if (!ends) requestAnimationFrame(count); }};
  requestAnimationFrame(count);
  const begin = performance.now();
  await new Promise((resolve) => setTimeout(resolve, {0}));
  ends = true;
  return (1000 * frames) / (performance.now() - begin);
}})()"""
_WINDOW_PX = 1280, 900


def measure(options: argparse.Namespace) -> Report:
    """Show the messages of some seconds to different numbers of pages, in turns."""
    report = Report("dashboard")
    seconds = _SMOKE_S if options.smoke else options.dashboard_seconds
    cases = {
        "no page": (0, False),
        "one page, no images": (1, False),
        "ten pages, no images": (10, False),
        "one page": (1, True),
        "ten pages": (10, True),
    }
    shares: dict[str, list[float]] = {name: [] for name in cases}
    rates: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(options.rounds):
        for name, (pages, with_images) in cases.items():
            share, rate_hz = _show(seconds, pages, with_images)
            shares[name].append(share)
            rates[name].append(rate_hz)
    for name, values in shares.items():
        wanted = ("<=", 0.1) if name == "one page, no images" else None
        report.rows.append(Row(name, tuple(values), "cores", wanted))
    for name, values in rates.items():
        if name != "no page":
            report.rows.append(Row(name, tuple(values), "updates/s"))
    if shutil.which("chromium") is None:
        report.remarks.append("dashboard: there is no chromium, so the frames of the page are not measured")
    else:
        drawn = tuple(_draw(seconds) for _ in range(options.rounds))
        report.rows.append(Row("one page in Chromium", drawn, "frames/s", (">=", 30.0)))
    return report


def _show(seconds: float, pages: int, with_images: bool) -> tuple[float, float]:
    """Return the share of a core, and the updates per second of the slowest page."""
    with _served() as (show, url), _open_pages(url, pages, with_images) as read:
        jpeg = _picture()
        fed_s = [0.0]
        feeder = threading.Thread(target=_feed, args=(show, jpeg, seconds, fed_s))
        begin_cpu_s, begin_s = time.process_time(), time.perf_counter()
        feeder.start()
        feeder.join()
        took_s = time.perf_counter() - begin_s
        cpu_s = time.process_time() - begin_cpu_s - fed_s[0]
        return cpu_s / took_s, read() / took_s


def _draw(seconds: float) -> float:
    """Return the frames per second of a page in Chromium while messages come."""
    from tests.web.phone import phone

    with tempfile.TemporaryDirectory() as folder, _served() as (show, url), phone(Path(folder)) as browser:
        ended, jpeg = threading.Event(), _picture()
        feeder = threading.Thread(target=_feed, args=(show, jpeg, float("inf"), [0.0], ended))
        feeder.start()
        try:
            browser.open(url, _WINDOW_PX)
            browser.wait(f"document.querySelectorAll('figure image').length === {len(_CAMERAS)}")
            return float(browser.run(_FRAMES.format(round(1000 * seconds))))
        finally:
            ended.set()
            feeder.join()


@contextmanager
def _served() -> Iterator[tuple[FanOut, str]]:
    """Serve a dashboard; yield its sinks and its address."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "live.mcap"
        log.write_bytes(bytes(1000))
        dashboard = _dashboard(log)
        with (
            FanOut([dashboard], lambda kind, text: None) as show,
            serve_app(build_dashboard(dashboard), port=0) as page,
        ):
            yield show, page.url


def _dashboard(log: Path) -> Dashboard:
    markers = tuple(RigMarker(n, robot=f"robot_{n}") for n in range(_ROBOTS))
    rig = Rig("lab", "DICT_4X4_100", 0.2, markers, floor=Floor(5.0, 5.0))
    states = {name: CameraState(up=True) for name in _CAMERAS}
    setting = DashboardSetting(rig, {}, None, "poly", states, {}, log, time.time_ns)
    return Dashboard(setting, Operator(lambda topic, payload: None, time.time_ns, lambda text: None))


def _feed(
    show: FanOut, jpeg: bytes, seconds: float, fed_s: list[float], ended: threading.Event | None = None
) -> None:
    """Send the messages at their times; note the processor time that making them took.

    The messages end after some seconds, or with an event.
    """
    begin_s = time.perf_counter()
    for number in count():
        if number >= seconds * _RATE_HZ or (ended is not None and ended.is_set()):
            break
        for message in _messages(number, jpeg):
            show(message)
        time.sleep(max(begin_s + (number + 1) / _RATE_HZ - time.perf_counter(), 0.0))
    fed_s[0] = time.thread_time()


def _messages(number: int, jpeg: bytes) -> Iterator[Message]:
    now_ns = time.time_ns()
    square_px = np.array([[0.0, 0], [40, 0], [40, 40], [0, 40]])
    for camera in _CAMERAS:
        yield Message(
            image_topic(camera), now_ns, now_ns, CompressedImage(now_ns, camera, jpeg, "jpeg"), camera
        )
        found = tuple(Marker(n, square_px + 50 * n) for n in range(_ROBOTS))
        topic = f"/runs/edges/cameras/{camera}/markers"
        yield Message(topic, now_ns, now_ns, Markers(now_ns, found, *_SIZE_PX), camera)
    angle = number / _RATE_HZ
    tracks = tuple(
        Track(f"robot_{n}", n, n % 5 + np.cos(angle), n // 5 + np.sin(angle), 0.1, angle, 4e-6 * np.eye(3))
        for n in range(_ROBOTS)
    )
    yield Message("/runs/poly/tracks", now_ns, now_ns, Tracks(now_ns, tracks))
    times_ns = [now_ns + n * _NS_PER_MS for n in range(1, 6)]
    yield Message(LATENCY_TOPIC, now_ns, now_ns, Latency(now_ns, "red", *times_ns), "red")


def _picture() -> bytes:
    """Return a frame of 1920 x 1080 with as much detail as a floor."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(60, 200, (_SIZE_PX[1] // 8, _SIZE_PX[0] // 8, 3), dtype=np.uint8)
    image = np.ascontiguousarray(coarse.repeat(8, axis=0).repeat(8, axis=1))
    return bytes(simplejpeg.encode_jpeg(image, quality=85, colorspace="RGB"))


@contextmanager
def _open_pages(url: str, number: int, with_images: bool) -> Iterator[Callable[[], int]]:
    """Open pages in a process of their own; yield a function that returns their smallest count of updates."""
    parts = urlsplit(url)
    arguments = [str(parts.hostname), str(parts.port), str(number), "images" if with_images else "none"]
    with subprocess.Popen(
        [sys.executable, "-c", _PAGES, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        assert program.stdin is not None
        stdin, stdout = program.stdin, program.stdout
        stdout.readline()

        def read() -> int:
            stdin.write("\n")
            stdin.flush()
            return int(stdout.readline())

        yield read
        program.kill()


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--dashboard-seconds", type=float, default=10.0, help="duration of each turn")


if __name__ == "__main__":
    command("dashboard")
