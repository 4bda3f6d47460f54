"""Cameras on the network, as real streams on loopback."""

import http.server
import re
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import count, islice
from pathlib import Path

import av
import pytest

from ipsys_log.capture.frames import Clock, Frame, SourceError
from ipsys_log.capture.network import open_network
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S
from tests.capture.streams import encode, make_jpegs, serve, serve_rtsp
from tests.ports import free_port
from tests.tiers import first_fast

MJPEG = ("-f", "mpjpeg", "-content_type", "multipart/x-mixed-replace;boundary=ffmpeg", "-listen", "1")
X264 = ("-c:v", "libx264", "-preset", "ultrafast", "-g", "10", "-bf", "0", "-pix_fmt", "yuv420p")
X265 = ("-c:v", "libx265", "-preset", "ultrafast", "-x265-params", "keyint=10:bframes=0:log-level=none")


# A limit far above any duration on a busy machine.
LIMIT_S = 240.0
# An RTSP sender reports its clock once in some seconds; the tests take less than three.
MOST_REPORTS = 3


def take(source: str, count: int, said: list[str] | None = None) -> list[Frame]:
    """Return the first frames of a stream."""
    said = [] if said is None else said
    with open_network(RigCamera("red", source=source), Clock(), said.append) as frames:
        return list(islice((frame for frame in frames if frame is not None), count))


def test_mjpeg_comes_byte_for_byte(tmp_path: Path) -> None:
    pictures = make_jpegs(tmp_path, 25)
    port = free_port()
    address = f"http://127.0.0.1:{port}/live"
    loop = ("-re", "-f", "image2", "-loop", "1", "-framerate", "100", "-i", str(tmp_path / "%03d.jpg"))
    said: list[str] = []
    with serve(*loop, "-c", "copy", *MJPEG, address, port=port):
        frames = take(address, 60, said)
    assert {(frame.format, frame.time_ns) for frame in frames} == {("jpeg", None)}
    # The frames that FFmpeg reads to probe the stream may be missing; after that, none are.
    first = pictures.index(frames[0].data)
    assert [frame.data for frame in frames] == [pictures[(first + n) % 25] for n in range(60)]
    assert said == ["camera red: sends no capture stamps; its frames get their time of arrival"]


def units(data: bytes, name: str) -> list[int]:
    """Return the types of the units in Annex B: H.264's 7 and 8, H.265's 32 to 34 are parameter sets."""
    heads = [data[match.end()] for match in re.finditer(b"\x00\x00\x01", data)]
    return [head & 31 if name == "h264" else head >> 1 & 63 for head in heads]


# FFmpeg 5 writes no H.265 into FLV; the tests of files cover the form of MP4.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "container"),
    first_fast(1, [("h264", X264, "mpegts"), ("h264", X264, "flv"), ("h265", X265, "mpegts")]),
)
def test_video_is_annex_b_and_readable_from_each_keyframe(
    tmp_path: Path, name: str, options: tuple[str, ...], container: str
) -> None:
    make_jpegs(tmp_path, 50)
    video = encode(tmp_path, "v.mp4", *options)
    port = free_port()
    address = f"http://127.0.0.1:{port}/live"
    play = ("-re", "-stream_loop", "-1", "-i", str(video), "-c", "copy", "-f", container, "-listen", "1")
    with serve(*play, address, port=port):
        frames = take(address, 45)
    assert {frame.format for frame in frames} == {name}
    keys = [n for n, frame in enumerate(frames) if {7, 8} <= set(units(frame.data, "h264"))]
    if name == "h265":
        keys = [n for n, frame in enumerate(frames) if {32, 33, 34} <= set(units(frame.data, name))]
    assert keys == list(range(0, 45, 10))
    # Each parameter set appears once: ours are not added if the stream has them.
    sets = (7, 8) if name == "h264" else (32, 33, 34)
    assert all(units(frames[n].data, name).count(kind) == 1 for n in keys for kind in sets)
    for first in (0, 20):
        assert count_pictures(name, frames[first:]) == 45 - first


def count_pictures(name: str, frames: list[Frame]) -> int:
    decoder = av.CodecContext.create("hevc" if name == "h265" else name, "r")
    assert isinstance(decoder, av.VideoCodecContext)
    pictures = [picture for frame in frames for picture in decoder.decode(av.Packet(frame.data))]
    return len(pictures) + len(decoder.decode(None))


@pytest.mark.parametrize(("shift_s", "what"), [(3600.0, "ahead of"), (-5.0, "behind")])
def test_stamps_of_a_clock_that_is_off_are_not_used(tmp_path: Path, shift_s: float, what: str) -> None:
    make_jpegs(tmp_path, 30)
    video = encode(tmp_path, "v.mp4", *X264)
    said: list[str] = []
    with serve_rtsp(video, shift_s) as address:
        frames = take(address, 20, said)
    assert {frame.time_ns for frame in frames} == {None}
    assert len(said) == 1
    assert what in said[0]
    assert "its stamps are not used" in said[0]


@pytest.fixture
def web(tmp_path: Path) -> Iterator[str]:
    """A web server without a camera: a page, an image, a sound, and an empty answer."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args: object) -> None:
            pass

    (tmp_path / "index.html").write_text("<h1>Camera</h1>" * 100)
    make_jpegs(tmp_path, 1)
    encode(tmp_path, "sound.wav", "-f", "lavfi", "-i", "sine=duration=1", "-map", "1")
    encode(tmp_path, "old.avi", "-c:v", "mpeg4")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path)) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/", "is not video; give the address of the stream, not of a web page"),
        ("/nothing", "has no such path"),
        ("/000.jpg", "is a single image"),
        ("/sound.wav", "is not video"),
        ("/old.avi", "is mpeg4 video; set the camera to MJPEG, H.264 or H.265"),
    ],
)
def test_invalid_stream_is_reported(web: str, path: str, said: str) -> None:
    with pytest.raises(SourceError, match=re.escape(said)) as error:
        take(web + path, 1)
    assert f"camera red: {web}{path}: " in str(error.value)
    assert "\n" not in str(error.value)


def playlist(url: str) -> bytes:
    return f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{url}\n#EXT-X-ENDLIST\n".encode()


@contextmanager
def answering(data: bytes) -> Iterator[str]:
    """Answer each connection with the same bytes, without HTTP."""

    class Answer(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            self.request.sendall(data)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        yield f"tcp://127.0.0.1:{server.server_address[1]}/live.m3u8"
        server.shutdown()


@pytest.fixture
def segment(tmp_path: Path) -> Path:
    """A video on this machine, in the folder of ``web``."""
    make_jpegs(tmp_path, 90)
    return encode(tmp_path, "private.ts", *X264)


def test_playlist_by_tcp_reads_no_file(segment: Path) -> None:
    with answering(playlist(segment.as_uri())) as address, pytest.raises(SourceError, match="is not video"):
        take(address, 1)
    with (
        answering(playlist(segment.as_uri())) as inner,
        answering(f"#EXTM3U\n#EXT-X-STREAM-INF:BANDWIDTH=1\n{inner}\n".encode()) as outer,
        pytest.raises(SourceError, match="is not video"),
    ):
        take(outer, 1)


def test_playlist_by_http_reads_only_http(web: str, segment: Path, tmp_path: Path) -> None:
    (tmp_path / "live.m3u8").write_bytes(playlist(segment.name))
    assert len(take(f"{web}/live.m3u8", 3)) == 3
    with answering(playlist(segment.as_uri())) as address:
        for number, url in enumerate([segment.as_uri(), address]):
            (tmp_path / f"{number}.m3u8").write_bytes(playlist(url))
            with pytest.raises(SourceError, match="is not video"):
                take(f"{web}/{number}.m3u8", 1)


def test_missing_server_is_reported() -> None:
    address = f"127.0.0.1:{free_port()}/live"
    with pytest.raises(SourceError, match=f"admin:[*]+@{address}: refuses the connection") as error:
        take(f"http://admin:secret@{address}", 1)
    assert "secret" not in str(error.value)
    with pytest.raises(SourceError, match=r"'no-such\.invalid'"):
        take("rtsp://no-such.invalid/live", 1)


@pytest.mark.parametrize(
    ("code", "said"), [(socket.EAI_NONAME, "does not exist"), (socket.EAI_AGAIN, "check the network")]
)
def test_name_that_leads_nowhere_says_why(code: int, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise socket.gaierror(code, "as the resolver says")

    monkeypatch.setattr("socket.getaddrinfo", fail)
    with pytest.raises(SourceError, match=said):
        take("rtsp://camera.lab/live", 1)


@pytest.mark.parametrize("host", ["camera..local", f"{'a' * 64}.local"])
def test_name_with_an_impossible_part_is_refused(host: str) -> None:
    with pytest.raises(SourceError, match=f"the host '{host}' does not exist"):
        take(f"rtsp://{host}/stream", 1)


def test_a_stream_that_falls_silent_is_left_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.network._SILENT_S", LIMIT_S)
    make_jpegs(tmp_path, 3)
    port = free_port()
    address = f"http://127.0.0.1:{port}/live"
    still = ("-re", "-f", "image2", "-loop", "1", "-framerate", "0.001", "-i", str(tmp_path / "%03d.jpg"))
    with serve(*still, "-c", "copy", *MJPEG, address, port=port):
        with open_network(RigCamera("silent", source=address), Clock(), lambda _: None) as frames:
            # The source reports regularly that no frame arrived.
            assert [next(frames) for _ in range(3)].count(None) >= 2
        # The thread still reads: the caller has not waited for it.
        assert "silent" in {thread.name for thread in threading.enumerate()}


class SecondsClock(Clock):
    """A clock that advances by a second with each reading."""

    def __init__(self) -> None:
        super().__init__()
        self._seconds = count()

    def now_ns(self) -> int:
        return next(self._seconds) * NS_PER_S


def test_stream_of_empty_parts_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.network._SILENT_S", LIMIT_S)
    pictures = make_jpegs(tmp_path, 3)
    left = threading.Event()

    class Camera(http.server.BaseHTTPRequestHandler):
        def log_message(self, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace;boundary=ffmpeg")
            self.end_headers()
            with suppress(OSError):
                for number in count():
                    data = pictures[number % 3] if number < 20 else b""
                    head = b"--ffmpeg\r\nContent-type: image/jpeg\r\nContent-length: %d\r\n\r\n" % len(data)
                    self.wfile.write(head + data + b"\r\n")
                    time.sleep(0.002)
            left.set()

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Camera) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        source = RigCamera("red", source=f"http://127.0.0.1:{server.server_address[1]}/live")
        found: list[Frame] = []
        with (
            pytest.raises(SourceError, match="sends only empty frames"),
            open_network(source, SecondsClock(), lambda _: None) as frames,
        ):
            found.extend(frame for frame in frames if frame is not None)
        assert len(found) > 5
        # The connection is closed too.
        assert left.wait(LIMIT_S)
        server.shutdown()


def test_a_stream_that_ends(tmp_path: Path) -> None:
    pictures = make_jpegs(tmp_path, 25)
    port = free_port()
    address = f"http://127.0.0.1:{port}/live"
    once = ("-re", "-f", "image2", "-framerate", "50", "-i", str(tmp_path / "%03d.jpg"))
    with serve(*once, "-c", "copy", *MJPEG, address, port=port):
        found: list[Frame] = []
        with (
            pytest.raises(SourceError, match="the stream has ended"),
            open_network(RigCamera("red", source=address), Clock(), lambda text: None) as frames,
        ):
            found.extend(frame for frame in frames if frame is not None)
    assert found[-1].data == pictures[-1]


def test_a_program_that_is_killed_ends_the_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.network._SILENT_S", LIMIT_S)
    make_jpegs(tmp_path, 3)
    port = free_port()
    address = f"http://127.0.0.1:{port}/live"
    loop = ("-re", "-f", "image2", "-loop", "1", "-framerate", "50", "-i", str(tmp_path / "%03d.jpg"))
    with (
        serve(*loop, "-c", "copy", *MJPEG, address, port=port) as program,
        open_network(RigCamera("red", source=address), Clock(), lambda _: None) as frames,
    ):
        assert isinstance(next(frame for frame in frames if frame), Frame)
        program.kill()
        try:
            list(frames)
        except SourceError as error:
            # The end of the connection ends the stream, not its silence.
            assert "no data for" not in str(error)  # noqa: PT017
