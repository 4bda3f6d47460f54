"""Faults of streams of cameras and damaged images: see ``contradictions.py``."""

from __future__ import annotations

import re
import socketserver
import subprocess
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from fault_trials import Fault, Outcome, Trial, cases_folder
from scenes import drawn

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import CompressedImage, Message
from ipsys_log.messages.channels import MARKERS, RUN_EVENTS
from ipsys_log.vision.decode import decode_colour
from ipsys_log.vision.jpeg import read_header

__all__ = ["FAULTS"]

_LAB = LabSettings(
    width=640, height=360, rate_hz=10.0, markers=6, stations=12, frames_per_station=2, drive_s=1.0
)
_FLIPS = 6
_RESTART = re.compile(rb"\xff[\xd0-\xd7]")
# The growth of memory is that between these times after the start, in s: caches fill before.
_SETTLED_S, _ENDED_S = 300, 2100


def _changed_log(trial: Trial, name: str, change: Callable[[bytes], bytes]) -> Path:
    """Write the rendered lab with other bytes of its images."""

    def messages() -> Iterable[Message]:
        with Session([drawn(replace(_LAB, seed=trial.seed))]) as session:
            for message in session.messages([topic for one in session.readers for topic in one.channels]):
                image = message.payload
                if isinstance(image, CompressedImage):
                    image = replace(image, data=change(image.data))
                yield replace(message, payload=image)

    path = trial.folder / f"{name}.mcap"
    write_log(path, messages())
    return path


def _corners(log: Path) -> dict[tuple[str | None, int, int], np.ndarray]:
    with Session([log]) as session:
        return {
            (message.camera, message.log_time_ns, marker.id): marker.corners_px
            for message in session.messages(session.topics(MARKERS, "edges"))
            for marker in message.payload.markers
        }


def _detected(trial: Trial, log: Path) -> tuple[str, int, int]:
    """Return the output of ``detect``, the number of markers, and that of corrupt frames."""
    output = trial.ipsys("detect", log)
    with Session([log]) as session:
        events = session.payloads(session.topics(RUN_EVENTS, "edges"))
    return output, len(_corners(log)), sum("corrupt" in event.kind for event in events)


def _with_restarts(data: bytes) -> bytes:
    pixels = decode_colour(CompressedImage(0, "", data, "jpeg"))
    options = [cv2.IMWRITE_JPEG_QUALITY, 85, cv2.IMWRITE_JPEG_RST_INTERVAL, 20]
    return cv2.imencode(".jpg", pixels, options)[1].tobytes()


def _surplus_before_restarts(data: bytes) -> bytes:
    data = _with_restarts(data)
    header = read_header(data)
    assert header is not None
    return data[: header.data_at] + _RESTART.sub(
        lambda match: b"\x12\x34\x56" + match[0], data[header.data_at :]
    )


def _flawed_stream(
    change: Callable[[bytes], bytes], original: Callable[[bytes], bytes] = bytes
) -> Callable[[Trial], Outcome]:
    def try_once(trial: Trial) -> Outcome:
        _, markers, corrupt = _detected(trial, _changed_log(trial, "flawed", change))
        clean = _changed_log(trial, "clean", original)
        _, expected, _ = _detected(trial, clean)
        figure = f"{markers} of {expected} markers found"
        return Outcome(markers >= expected and not corrupt, figure=figure)

    return try_once


def _halves(trial: Trial) -> Outcome:
    log = trial.folder / "half.mcap"
    rig = cases_folder() / "images" / "lab.toml"
    trial.ipsys("import", "ros", cases_folder() / "images" / "halfframe", "-o", log, "--rig", rig)
    output, markers, _ = _detected(trial, log)
    return Outcome("corrupt" in output, figure=f"{markers} markers in half images")


def _flipped_bits(trial: Trial) -> Outcome:
    """Flip one bit in images, in the file: the CRC of their chunk shows it."""
    clean = _changed_log(trial, "clean", bytes)
    with Session([clean]) as session:
        images = [message.payload.data for message in session.messages([*session.images.values()])]
    content, rng = clean.read_bytes(), np.random.default_rng(trial.seed)
    log = trial.folder / "flipped.mcap"
    trial.ipsys("detect", clean)
    expected, named, moved = _corners(clean), 0, 0
    for image in rng.permutation(np.array(images, dtype=object))[:_FLIPS]:
        data = bytearray(content)
        data[content.find(image) + int(rng.integers(700, len(image) - 2))] ^= 1 << int(rng.integers(8))
        log.write_bytes(data)
        named += "CRC" in trial.ipsys("detect", log)
        corners = _corners(log)
        moved += corners.keys() != expected.keys() or any(
            not np.array_equal(corners[key], expected[key]) for key in corners
        )
    return Outcome(named == _FLIPS, figure=f"{named} of {_FLIPS} flips named, {moved} change the markers")


@contextmanager
def _playlist(video: Path) -> Iterator[str]:
    """Answer each connection with a playlist of a file of this machine."""
    data = f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{video.as_uri()}\n#EXT-X-ENDLIST\n".encode()

    class Answer(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            self.request.sendall(data)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        yield f"tcp://127.0.0.1:{server.server_address[1]}/live.m3u8"
        server.shutdown()


def _local_file(trial: Trial) -> Outcome:
    video, log = trial.folder / "private.ts", trial.folder / "read.mcap"
    source = (
        "-f",
        "lavfi",
        "-i",
        "testsrc=size=320x240:rate=10:duration=9",
        "-pix_fmt",
        "yuv420p",
        "-c:v",
        "libx264",
    )
    subprocess.run(["ffmpeg", "-v", "error", *source, "-g", "5", "-bf", "0", str(video)], check=True)
    with _playlist(video) as address:
        rig = trial.folder / "lab.toml"
        rig.write_text(
            'name = "a"\ndictionary = "DICT_4X4_50"\nmarker_length_m = 0.1\n'
            f'[[cameras]]\nname = "red"\nsource = "{address}"\n'
        )
        output = trial.ipsys("record", "--rig", rig, "-o", log, "--seconds", 2)
    frames = 0
    if log.exists():
        with LogReader(log) as reader:
            frames = sum(one.message_count for topic, one in reader.channels.items() if "image" in topic)
    return Outcome("is not video" in output, figure=f"{frames} frames of a local file read")


def _memory_of_live(trial: Trial) -> Outcome:
    rig, model, log = (trial.folder / name for name in ("lab.toml", "model.mcap", "live.mcap"))
    sample = Path(__file__).parent.parent / "sample_logs" / "paper_lab.mcap"
    trial.ipsys("replay", sample, "-o", model, "--model", "poly")
    trial.ipsys("init", rig, "--simulated")
    text = rig.read_text().replace("width = 1280", "width = 640").replace("height = 720", "height = 360")
    rig.write_text(text)
    sizes_mb: dict[int, float] = {}
    ended = threading.Event()

    def watch() -> None:
        for second in range(_ENDED_S):
            if ended.wait(1.0):
                return
            sizes_mb[second] = _resident_mb(log)

    watcher = threading.Thread(target=watch)
    watcher.start()
    live = ("live", "--rig", rig, "--model-from", model, "-o", log, "--seconds", _ENDED_S + 60)
    trial.ipsys(*live, timeout_s=2 * _ENDED_S)
    ended.set()
    watcher.join()
    minutes, settled = np.array([*sizes_mb]) / 60, next(iter(sizes_mb)) + _SETTLED_S
    late = [second for second in sizes_mb if second >= settled]
    growth = float(np.polyfit(np.array(late) / 60, [sizes_mb[second] for second in late], 1)[0])
    return Outcome(growth < 0.2, figure=f"{growth:.2f} MB/min after {minutes[-1]:.0f} min")


def _resident_mb(log: Path) -> float:
    """Return the memory of the process that writes a log, in MB; 0 if there is none."""
    for process in Path("/proc").iterdir():
        if process.name.isdecimal():
            try:
                if str(log).encode() in (process / "cmdline").read_bytes():
                    return int((process / "statm").read_text().split()[1]) * 4096 / 1e6
            except OSError:
                continue
    return 0.0


FAULTS: Sequence[Fault] = (
    Fault(
        "JPEG: bytes before restart markers", _flawed_stream(_surplus_before_restarts, _with_restarts), True
    ),
    Fault("JPEG: no end marker", _flawed_stream(lambda data: data[:-2]), True),
    Fault("JPEG: half of each image is missing", _halves),
    Fault("a flipped bit in an image", _flipped_bits, is_random=True),
    Fault("a camera sends a playlist of local files", _local_file),
    Fault("live: memory grows", _memory_of_live),
)
