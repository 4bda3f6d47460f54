"""Real streams on loopback: FFmpeg serves them, and an RTSP server forwards FFmpeg's RTP packets."""

import shutil
import socket
import socketserver
import struct
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg

from tests.waiting import wait_until

# A limit far above any duration on a busy machine.
_LIMIT_S = 240.0
# The option of Linux for a buffer above the limit of the system; only root may set it.
_SO_RCVBUFFORCE = 33


def ffmpeg() -> str:
    """Return the path of a program; skip the test if it is not installed."""
    found = shutil.which("ffmpeg")
    if found is None:
        pytest.skip("no ffmpeg; on Debian: sudo apt-get install ffmpeg")
    return found


def make_jpegs(folder: Path, count: int, width: int = 320, height: int = 240) -> list[bytes]:
    """Write different images as ``000.jpg`` and so on."""
    rng = np.random.default_rng(7)
    rows, columns = np.indices((height, width))
    pictures = []
    for number in range(count):
        grey = (rows + columns + 16 * number) % 256 + rng.integers(-8, 9, (height, width))
        picture = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        pictures.append(simplejpeg.encode_jpeg(picture, quality=80, colorsubsampling="422"))
        (folder / f"{number:03}.jpg").write_bytes(pictures[-1])
    return pictures


def encode(folder: Path, name: str, *options: str, rate: int = 30) -> Path:
    """Encode the images of a folder as a video."""
    path = folder / name
    inputs = ["-framerate", str(rate), "-i", str(folder / "%03d.jpg")]
    subprocess.run([ffmpeg(), "-v", "error", "-y", *inputs, *options, str(path)], check=True)
    return path


@contextmanager
def serve(*options: str, port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Run FFmpeg, listening on a loopback port for one client."""
    program = subprocess.Popen([ffmpeg(), "-v", "quiet", "-nostdin", *options], stderr=subprocess.DEVNULL)
    try:
        _await_listening(port, program)
        yield program
    finally:
        program.kill()
        program.wait()


def _await_listening(port: int, program: subprocess.Popen[bytes]) -> None:
    """Check the port without a connection, because FFmpeg accepts only one client."""
    local = f"0100007F:{port:04X}"

    def is_listening() -> bool:
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        return any(row[1] == local and row[3] == "0A" for row in rows)  # 0A means that it listens

    wait_until(is_listening, f"FFmpeg listens at port {port}", programs=[program])


@contextmanager
def serve_rtsp(video: Path, clock_shift_s: float = 0.0) -> Iterator[str]:
    """Return the address of a video as an RTSP stream; the clock of the server may have an error.

    FFmpeg makes the packets and the clock reports (RTP and RTCP). The server sends them in the TCP
    connection of the client, as in RFC 2326 (10.12).
    """
    with _bound() as rtp, _bound() as rtcp:
        sdp = video.with_suffix(".sdp")
        ports = rtp.getsockname()[1], rtcp.getsockname()[1]
        target = f"rtp://127.0.0.1:{ports[0]}?rtcpport={ports[1]}"
        loop = ["-re", "-stream_loop", "-1", "-i", str(video), "-c", "copy"]
        command = [ffmpeg(), "-v", "quiet", "-nostdin", *loop, "-f", "rtp", "-sdp_file", str(sdp), target]
        program = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            wait_until(
                lambda: sdp.exists() and sdp.read_text().endswith("\n") and "m=" in sdp.read_text(),
                "FFmpeg describes its stream",
                programs=[program],
            )
            server = _RtspServer(("127.0.0.1", 0), _RtspClient)
            server.sdp = sdp.read_text().replace(f"m=video {ports[0]}", "m=video 0")
            server.sockets, server.shift_s = (rtp, rtcp), clock_shift_s
            threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
            yield f"rtsp://127.0.0.1:{server.server_address[1]}/live"
            server.ended = True
            server.shutdown()
            server.server_close()
        finally:
            program.kill()
            program.wait()


@contextmanager
def _bound() -> Iterator[socket.socket]:
    with socket.socket(type=socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.settimeout(0.1)
        with suppress(PermissionError):  # packets wait here while the relay gets no time
            made.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 1 << 25)
        yield made


class _RtspServer(socketserver.ThreadingTCPServer):
    daemon_threads = True
    sdp: str
    sockets: tuple[socket.socket, socket.socket]
    shift_s: float
    ended = False


class _RtspClient(socketserver.StreamRequestHandler):
    server: _RtspServer

    def handle(self) -> None:
        lock = threading.Lock()
        while request := self.rfile.readline():
            if request[:1] == b"$":  # reports of the client
                continue
            lines = iter(lambda: self.rfile.readline().strip(), b"")
            fields = dict(line.decode().split(": ", 1) for line in lines if b": " in line)
            method, address = request.decode().split()[:2]
            body, head = "", {"CSeq": fields["CSeq"]}
            status = "200 OK" if "/live" in address else "404 Not Found"
            if method == "DESCRIBE" and status == "200 OK":
                body = self.server.sdp
                head |= {"Content-Type": "application/sdp", "Content-Length": str(len(body))}
            elif method == "SETUP":
                head |= {"Transport": "RTP/AVP/TCP;unicast;interleaved=0-1", "Session": "1"}
            answer = "".join(f"{key}: {value}\r\n" for key, value in head.items())
            with lock:
                self.wfile.write(f"RTSP/1.0 {status}\r\n{answer}\r\n{body}".encode())
            if method == "PLAY":
                for channel in (0, 1):
                    threading.Thread(target=self._relay, args=(channel, lock), daemon=True).start()

    def _relay(self, channel: int, lock: Any) -> None:
        while not self.server.ended:
            try:
                data = self.server.sockets[channel].recv(65536)
                if channel == 1:
                    data = self._shifted(data)
                with lock:
                    self.wfile.write(struct.pack(">cBH", b"$", channel, len(data)) + data)
            except TimeoutError:
                continue
            except OSError:
                return

    def _shifted(self, report: bytes) -> bytes:
        """Return a sender's report (RFC 3550, 6.4.1) with its clock advanced: 64 bits of 2**-32 s, at 8."""
        if len(report) < 16 or report[1] != 200:
            return report
        (ntp,) = struct.unpack_from(">Q", report, 8)
        return report[:8] + struct.pack(">Q", ntp + int(self.server.shift_s * 2**32)) + report[16:]
