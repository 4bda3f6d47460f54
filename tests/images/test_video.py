"""Markers in a video: the images equal those of FFmpeg's own decoder."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture.video_files import pass_through
from ipsys_log.errors import FrameError
from ipsys_log.messages import CompressedVideo, Event, Markers, Message, RawImage, Rig
from ipsys_log.stages.detect import Detect
from ipsys_log.vision.video import Video, decode_keyframe, is_keyframe
from tests.capture.streams import encode, ffmpeg

CODECS = {
    "h264": ("-c:v", "libx264", "-bf", "0", "-g", "5", "-pix_fmt", "yuv420p"),
    "h265": ("-c:v", "libx265", "-x265-params", "bframes=0:keyint=5:log-level=none", "-pix_fmt", "yuv420p"),
}


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Encode a marker that moves 4 px per frame."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    for number in range(12):
        grey = np.full((240, 330), 220, np.uint8)
        grey[60:160, 40 + 4 * number : 140 + 4 * number] = cv2.aruco.generateImageMarker(dictionary, 6, 100)
        cv2.imwrite(str(tmp_path / f"{number:03}.jpg"), grey)
    return tmp_path


def frames(video: Path, name: str) -> list[CompressedVideo]:
    with av.open(video) as container:
        stream = container.streams.video[0]
        packets = pass_through(container.demux(stream), stream)
        return [CompressedVideo(n, "red", bytes(packet), name) for n, packet in enumerate(packets)]


def decoded_by_ffmpeg(video: Path) -> NDArray[np.uint8]:
    command = [ffmpeg(), "-v", "error", "-i", str(video), "-f", "rawvideo", "-pix_fmt", "yuv420p", "-"]
    raw = subprocess.run(command, check=True, capture_output=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, 240 * 330 * 3 // 2)[:, : 240 * 330].reshape(-1, 240, 330)


def pixels(picture: RawImage | None) -> bytes | None:
    """Remove the padding of the rows."""
    if picture is None:
        return None
    rows = np.frombuffer(picture.data, np.uint8).reshape(picture.height, picture.step)
    return rows[:, : picture.width].tobytes()


@pytest.mark.parametrize("name", CODECS)
def test_pictures_are_those_of_ffmpeg(pictures: Path, name: str) -> None:
    video = encode(pictures, "video.mp4", *CODECS[name])
    decode = Video(name)
    seen = [decode(frame) for frame in frames(video, name)]
    expected = decoded_by_ffmpeg(video)
    assert len(seen) == len(expected) == 12
    for picture, true in zip(seen, expected, strict=True):
        assert picture is not None
        assert picture.encoding == "mono8"
        rows = np.frombuffer(picture.data, np.uint8).reshape(picture.height, picture.step)
        # Studio levels (16 to 235) are stretched to the full scale.
        full = np.clip((true.astype(float) - 16) * 255 / 219, 0, 255)
        assert np.abs(rows[:, : picture.width] - full).max() <= 1.0


def run(detect: Detect, video: list[CompressedVideo]) -> list[object]:
    list(detect(Message("/rig", 0, 0, Rig("lab", "DICT_4X4_100", 0.2))))
    found: list[object] = []
    for frame in video:
        found += detect(Message("/cameras/red/image", frame.timestamp, frame.timestamp, frame, "red"))
    return found


def test_markers_are_found_from_the_first_keyframe_on(pictures: Path) -> None:
    video = frames(encode(pictures, "video.mp4", *CODECS["h264"]), "h264")
    found = run(Detect("stock"), video[2:])
    events = [payload for payload in found if isinstance(payload, Event)]
    assert [(event.kind, event.timestamp, event.camera) for event in events] == [("no_keyframe", 2, "red")]
    seen = [payload for payload in found if isinstance(payload, Markers)]
    assert [frame.timestamp for frame in seen] == [5, 6, 7, 8, 9, 10, 11]
    # the drawn position of the marker's first corner
    for frame in seen:
        (marker,) = frame.markers
        assert marker.id == 6
        assert np.abs(marker.corners_px[0] - [39.5 + 4 * frame.timestamp, 59.5]).max() < 0.7


def test_invalid_video_data_is_a_corrupt_frame(pictures: Path) -> None:
    video = frames(encode(pictures, "video.mp4", *CODECS["h264"]), "h264")
    broken = CompressedVideo(3, "red", b"\x00\x00\x00\x01\x65nothing of the kind", "h264")
    found = run(Detect("stock"), [*video[:3], broken, *video[5:]])
    assert [payload.kind for payload in found if isinstance(payload, Event)] == ["corrupt_frame"]
    assert [p.timestamp for p in found if isinstance(p, Markers)] == [0, 1, 2, *range(5, 12)]
    with pytest.raises(FrameError, match="video format 'vp9' is not read"):
        Video("vp9")


def test_a_picture_that_needs_a_later_one_is_named(pictures: Path) -> None:
    video = frames(encode(pictures, "video.mp4", *CODECS["h264"], "-bf", "2"), "h264")
    events = [payload for payload in run(Detect("stock"), video) if isinstance(payload, Event)]
    assert events
    assert "turn off B-frames" in events[0].text


@pytest.mark.parametrize("name", CODECS)
def test_frames_before_a_keyframe_do_not_change_its_image(pictures: Path, name: str) -> None:
    """A slow live run continues at a keyframe; its replay has decoded all frames before it."""
    video = frames(encode(pictures, "video.mp4", *CODECS[name]), name)
    assert [n for n, frame in enumerate(video) if is_keyframe(frame)] == [0, 5, 10]
    video[5] = replace(video[5], data=video[5].data[:-200] + bytes(200))

    def seen(decode: Video) -> list[bytes | str | None]:
        found: list[bytes | str | None] = []
        for frame in video[5:]:
            try:
                found.append(pixels(decode(frame)))
            except FrameError as error:
                found.append(str(error))
        return found

    behind, before = Video(name), Video(name)
    for frame in video[:5]:
        before.skip(frame)
    found = seen(behind)
    assert found == seen(before)
    assert [type(one) for one in found] == [*[str] * 5, *[bytes] * 2]


def test_a_keyframe_by_itself(pictures: Path) -> None:
    video = frames(encode(pictures, "video.mp4", *CODECS["h264"]), "h264")
    whole = Video("h264")
    assert pixels(decode_keyframe(video[5])) == [pixels(whole(frame)) for frame in video[:6]][-1]
    with pytest.raises(FrameError, match="are no keyframe"):
        decode_keyframe(video[6])


BASELINE = ("-profile:v", "baseline", "-refs", "1")
HIGH = ("-profile:v", "high", "-refs", "4", "-x264-params", "keyint=40:scenecut=0:slices=3:bframes=0")
H265 = ("-c:v", "libx265", "-x265-params", "bframes=0:keyint=40:scenecut=0:log-level=none")
FULL = ("-profile:v", "high444", "-pix_fmt", "yuv444p", "-crf", "0")


@pytest.mark.parametrize("options", [BASELINE, HIGH, FULL, H265])
def test_lost_frame_is_not_replaced(pictures: Path, options: tuple[str, ...]) -> None:
    """Over UDP, some packets are lost; FFmpeg would show the previous image."""
    name = "h265" if "libx265" in options else "h264"
    for number in range(12, 60):  # more than the range of frame numbers, 16 at least
        shutil.copy(pictures / f"{number % 12:03}.jpg", pictures / f"{number:03}.jpg")
    video = frames(
        encode(pictures, "video.mp4", *CODECS["h264"], *options, "-g", "40", "-sc_threshold", "0"), name
    )
    whole = Video(name)
    true = [pixels(whole(frame)) for frame in video]
    assert len(true) == 60
    assert None not in true
    for lost in (1, 20, 39, 41):
        decode = Video(name)
        for n, frame in enumerate(video):
            if n == lost:
                continue
            if lost < n < 40 * (lost // 40 + 1):
                with pytest.raises(FrameError):
                    decode(frame)
            else:
                assert pixels(decode(frame)) == true[n]


@pytest.mark.parametrize("name", sorted(CODECS))
def test_any_keyframe_can_follow_any_frame(pictures: Path, name: str) -> None:
    """A slow machine skips up to a keyframe. Keyframes of H.265 may have equal picture order counts."""
    video = frames(encode(pictures, "video.mp4", *CODECS[name]), name)
    looped = [*video, *video]
    true = [pixels(decode_keyframe(frame)) for frame in looped if is_keyframe(frame)]
    assert len(true) == 6
    for last in range(len(looped)):
        later = [n for n, frame in enumerate(looped) if is_keyframe(frame) and n > last]
        for number, expected in zip(later, true[-len(later) :], strict=False):
            decode = Video(name)
            for frame in looped[: last + 1]:
                decode.skip(frame)
            assert pixels(decode(looped[number])) == expected
