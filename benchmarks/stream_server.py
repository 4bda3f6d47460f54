"""Streams of the simulated lab on loopback: one FFmpeg for each camera, and a rig of these cameras."""

from __future__ import annotations

import errno
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ipsys_log.log.dataset import Session
from ipsys_log.messages.rig_file import rig_toml

__all__ = ["Served", "free_ports", "loops_of", "serve", "write_lens"]

_TURN_S = 0.05
_FORMAT = ("-f", "mpjpeg", "-content_type", "multipart/x-mixed-replace;boundary=ffmpeg", "-listen", "1")


@dataclass(slots=True)
class Served:
    """Streams that wait for a reader: the rig file, the cameras, and by name why others are missing."""

    rig: Path
    cameras: list[str] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)


def loops_of(lab: Path, folder: Path) -> dict[str, Path]:
    """Write the drive of each camera as a file of JPEGs, forward and backward, so that nothing jumps."""
    loops = {}
    with Session([lab]) as session:
        for name, topic in session.images.items():
            frames = [message.payload.data for message in session.messages([topic])][-60:]
            loops[name] = folder / f"{name}.mjpeg"
            loops[name].write_bytes(b"".join([*frames, *frames[-2:0:-1]]))
    return loops


@contextmanager
def serve(lab: Path, loops: Mapping[str, Path], count: int, folder: Path, limit_s: float) -> Iterator[Served]:
    """Serve ``count`` cameras while the block lasts.

    Parameters
    ----------
    lab : the log with the rig and the intrinsics of the cameras.
    loops : a file of JPEGs by camera; if there are more cameras than files, cameras share the files.
    limit_s : time to wait for all streams; a stream that does not listen by then is missing.
    """
    with Session([lab]) as session:
        text = rig_toml(session.payloads(["/rig"])[0]).partition("[[cameras]]")[0]
        lenses = {name: session.payloads([topic])[0] for name, topic in session.calibrations.items()}
    served = Served(folder / "lab.toml")
    with ExitStack() as stack:
        programs = {}
        for number, port in enumerate(free_ports(count)):
            base = sorted(loops)[number % len(loops)]
            name = base if number < len(loops) else f"{base}_{number}"
            address = f"http://127.0.0.1:{port}/{name}"
            said = folder / f"{name}.txt"
            programs[name] = port, _start(loops[base], address, said, stack), said, address, lenses[base]
        end_s = time.monotonic() + limit_s
        for name, (port, program, said, address, lens) in programs.items():
            why = _wait_for(port, program, said, end_s)
            if why is not None:
                served.missing[name] = why
                continue
            served.cameras.append(name)
            file = write_lens(folder / f"{name}.yaml", lens)
            text += f'[[cameras]]\nname = "{name}"\nsource = "{address}"\ncalibration = "{file}"\n'
        served.rig.write_text(text, encoding="utf-8")
        yield served


def free_ports(count: int) -> list[int]:
    """Return ports that are not in use now, all different."""
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]


def _start(loop: Path, address: str, said: Path, stack: ExitStack) -> subprocess.Popen[bytes]:
    source = ["-re", "-stream_loop", "-1", "-f", "mjpeg", "-framerate", "30", "-i", str(loop)]
    program = subprocess.Popen(
        ["ffmpeg", "-v", "error", "-nostdin", *source, "-c", "copy", *_FORMAT, address],
        stderr=stack.enter_context(said.open("wb")),
    )
    stack.callback(program.wait)
    stack.callback(program.kill)
    return program


def _wait_for(port: int, program: subprocess.Popen[bytes], said: Path, end_s: float) -> str | None:
    """Wait until a program listens at a port; return the reason if it never does.

    FFmpeg serves only its first reader. So a connection as a test whether it listens would end the stream.
    """
    while not _listened_at(port):
        if program.poll() is not None:
            lines = said.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["no word"]
            return f"ffmpeg ended with {program.returncode}: {lines[-1]}"
        if time.monotonic() > end_s:
            return "ffmpeg did not listen in time"
        time.sleep(_TURN_S)
    return None


def _listened_at(port: int) -> bool:
    """Return True if a program listens at a port; the test makes no connection."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            return error.errno == errno.EADDRINUSE
        return False


def write_lens(path: Path, lens: Any) -> str:
    """Write the intrinsics of a camera as a file of OpenCV; return its name."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("camera_matrix", np.ascontiguousarray(lens.K))
    file.write("distortion_coefficients", np.ascontiguousarray(lens.D))
    file.write("image_width", lens.width)
    file.write("image_height", lens.height)
    file.release()
    return path.name
