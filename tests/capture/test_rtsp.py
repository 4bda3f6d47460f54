"""Cameras by RTSP from the server of GStreamer, as independent software."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice, pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture.frames import Clock, Frame, SourceError
from ipsys_log.capture.network import open_network
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S
from tests.capture.streams import encode, make_jpegs
from tests.capture.test_network import LIMIT_S, MOST_REPORTS
from tests.tiers import first_fast

SERVER = Path(__file__).with_name("rtsp_server.py")
# The bindings of GStreamer belong to the system's Python, not to ours.
PYTHON = "/usr/bin/python3"
FINDS = "import gi; gi.require_version('Gst', '1.0'); gi.require_version('GstRtspServer', '1.0')"
HAS_SERVER = sys.platform == "linux" and not subprocess.run([PYTHON, "-c", FINDS], check=False).returncode
pytestmark = pytest.mark.skipif(
    not HAS_SERVER,
    reason="no RTSP server; on Debian: sudo apt-get install gir1.2-gst-rtsp-server-1.0 python3-gi "
    "gstreamer1.0-plugins-good gstreamer1.0-plugins-bad",
)

YUV = ("-pix_fmt", "yuv420p")
CODECS = {
    "h264": ("-c:v", "libx264", "-preset", "ultrafast", "-g", "10", "-bf", "0", *YUV),
    "h265": ("-c:v", "libx265", "-x265-params", "keyint=10:bframes=0:log-level=none", *YUV),
    "jpeg": ("-c", "copy"),
}
PAYLOADERS = {
    "h264": "h264parse ! rtph264pay", "h265": "h265parse ! rtph265pay", "jpeg": "jpegparse ! rtpjpegpay",
}  # fmt: skip


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return five seconds of each kind; no two images are the same."""
    folder = tmp_path_factory.mktemp("rtsp")
    make_jpegs(folder, 150)
    return {name: encode(folder, f"{name}.mov", *options) for name, options in CODECS.items()}


@contextmanager
def served(video: Path, protocol: str, authentication: str = "none", user: str = "") -> Iterator[str]:
    command = [PYTHON, str(SERVER), str(video), PAYLOADERS[video.stem], protocol, authentication]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        try:
            yield f"rtsp://{user}127.0.0.1:{program.stdout.readline().strip()}/live"
        finally:
            program.kill()


def take(source: str, count: int, said: list[str]) -> list[Frame]:
    with open_network(RigCamera("red", source=source), Clock(), said.append) as frames:
        return list(islice((frame for frame in frames if frame is not None), count))


def decoded(name: str, frames: list[bytes]) -> list[NDArray[np.uint8]]:
    codec = av.CodecContext.create({"h265": "hevc", "jpeg": "mjpeg"}.get(name, name), "r")
    assert isinstance(codec, av.VideoCodecContext)
    pictures = [one for data in frames for one in codec.decode(av.Packet(data))] + codec.decode(None)
    return [np.asarray(one.to_ndarray(format="gray"), np.uint8) for one in pictures]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "protocol"),
    first_fast(1, [("h264", "tcp"), ("h264", "udp"), ("h265", "tcp"), ("jpeg", "tcp"), ("jpeg", "udp")]),
)
def test_every_frame_comes_with_the_cameras_stamp(
    videos: dict[str, Path], name: str, protocol: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ipsys_log.capture.network._OLDEST_NS", round(LIMIT_S * NS_PER_S))
    said: list[str] = []
    with served(videos[name], protocol) as address:
        clock = Clock()
        start_ns = clock.now_ns()
        frames = take(address, 80, said)
        end_ns = clock.now_ns()
    assert {frame.format for frame in frames} == {name}
    came = decoded(name, [frame.data for frame in frames])
    assert len(came) == 80
    with av.open(str(videos[name])) as container:
        sent = [picture.to_ndarray(format="gray") for picture in container.decode(video=0)]
    first = next(n for n, picture in enumerate(sent) if np.array_equal(picture, came[0]))
    assert all(np.array_equal(*pair) for pair in zip(sent[first:], came, strict=False))
    stamps = [frame.time_ns for frame in frames if frame.time_ns is not None]
    assert len(stamps) > 5
    assert start_ns < stamps[0] < stamps[-1] <= end_ns
    # Frames are one period apart; a report of a busy server shifts all later ones.
    steps = np.array([after - before for before, after in pairwise(stamps)]) - NS_PER_S / 30
    assert np.sort(np.abs(steps))[:-MOST_REPORTS].max() < 1e6
    assert len(said) == 1
    assert "the stamps of the camera (RTCP)" in said[0]


@pytest.mark.parametrize("authentication", ["basic", "digest"])
def test_a_password(videos: dict[str, Path], authentication: str) -> None:
    with served(videos["h264"], "tcp", authentication, "admin:hush@") as address:
        assert len(take(address, 3, [])) == 3
    for user in ("", "admin:wrong@"):
        with (
            served(videos["h264"], "tcp", authentication, user) as address,
            pytest.raises(SourceError, match="the password is missing or not accepted;") as error,
        ):
            take(address, 1, [])
        assert "wrong" not in str(error.value)
