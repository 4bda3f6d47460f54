"""Images for a calibration of intrinsics, from logs, folders, files and videos."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.calibration.images import find_sources
from ipsys_log.engine.output import write_log
from ipsys_log.errors import IpsysError
from ipsys_log.messages import RIG_TOPIC, Message, RawImage, Rig

S = 1_000_000_000
# Rows of different grey levels: a wrong step or order of channels gives another picture.
GREY = np.repeat(np.arange(24, dtype=np.uint8)[:, None] * 10, 32, axis=1)


def raw(encoding: str, pixels: np.ndarray, padding: int = 0) -> RawImage:
    """Return an image of rows of pixels; each row is followed by ``padding`` bytes."""
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    padded = np.hstack([rows, np.full((height, padding), 99, dtype=np.uint8)])
    return RawImage(S, "red", width, height, encoding, padded.shape[1], padded.tobytes())


def write_frames(path: Path, *frames: RawImage) -> Path:
    messages = [
        Message("/cameras/red/image", n * S, n * S, frame, "red") for n, frame in enumerate(frames, 1)
    ]
    write_log(path, [Message(RIG_TOPIC, 1, 1, Rig("lab", "DICT_4X4_100", 0.2)), *messages])
    return path


def test_raw_images_of_every_encoding_become_grey(tmp_path: Path) -> None:
    colour = np.stack([GREY, GREY // 2, GREY // 3], axis=2)
    transparent = np.dstack([colour, np.full_like(GREY, 255)])
    expected = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    log = write_frames(
        tmp_path / "raw.mcap",
        raw("mono8", GREY),
        raw("mono8", GREY, padding=5),
        raw("rgb8", colour, padding=1),
        raw("bgr8", np.ascontiguousarray(colour[..., ::-1])),
        raw("rgba8", transparent),
    )
    (source,) = find_sources([log], [])
    names, pictures = zip(*source.read(), strict=True)
    assert names == tuple(f"at {n:.2f} s" for n in range(1, 6))
    for picture, wanted in zip(pictures, (GREY, GREY, expected, expected, expected), strict=True):
        np.testing.assert_array_equal(picture, wanted)


@pytest.mark.parametrize(
    "damage",
    [
        lambda frame: RawImage(S, "red", 32, 24, "mono8", 16, frame.data),
        lambda frame: RawImage(S, "red", 32, 25, "mono8", 32, frame.data),
        lambda frame: RawImage(S, "red", 0, 24, "mono8", 0, frame.data),
        lambda frame: RawImage(S, "red", 32, 24, "bayer_rggb8", 32, frame.data),
    ],
    ids=["short step", "rows missing", "no width", "unknown encoding"],
)
def test_unreadable_image_is_none(tmp_path: Path, damage: Callable[[RawImage], RawImage]) -> None:
    log = write_frames(tmp_path / "raw.mcap", damage(raw("mono8", GREY)), raw("mono8", GREY))
    (source,) = find_sources([log], [])
    first, second = (picture for _, picture in source.read())
    assert first is None
    np.testing.assert_array_equal(second, GREY)


def test_several_sources_of_a_camera_are_one(tmp_path: Path) -> None:
    logs = [write_frames(tmp_path / f"{name}.mcap", raw("mono8", GREY)) for name in ("one", "two")]
    (source,) = find_sources(logs, [])
    assert (source.camera, source.total, source.examined_count) == ("red", 2, 2)
    assert source.source == f"{logs[0]}: camera red and 1 more"
    assert len(list(source.read())) == 2


def test_image_file_is_of_the_camera_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "red").mkdir()
    picture = tmp_path / "red/1.png"
    cv2.imwrite(str(picture), GREY)
    (source,) = find_sources([picture], [])
    assert (source.camera, source.total) == ("red", 1)
    ((_, read),) = source.read()
    np.testing.assert_array_equal(read, GREY)


def test_missing_sources_are_named(tmp_path: Path) -> None:
    log = write_frames(tmp_path / "raw.mcap", raw("mono8", GREY))
    empty = tmp_path / "empty.mcap"
    write_log(empty, [Message(RIG_TOPIC, 1, 1, Rig("lab", "DICT_4X4_100", 0.2))])
    (tmp_path / "notes.txt").write_text("1 2 3")
    picture = tmp_path / "1.png"
    cv2.imwrite(str(picture), GREY)
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    for path, cameras, text in (
        (tmp_path / "none", (), "none: does not exist; give a log, folder, picture or video"),
        (tmp_path / "notes.txt", (), "notes.txt: is not a log (.mcap), a picture"),
        (tmp_path / "broken.mp4", (), "broken.mp4: cannot be read as a video; convert it to H.264"),
        (empty, (), "empty.mcap: has no frames of any camera"),
        (log, ("white",), "--camera white: this camera has no frames; the cameras are red"),
        (picture, ("red", "white"), "1.png: is of one camera, but several are given; give one --camera"),
    ):
        with pytest.raises(IpsysError, match=re.escape(text)):
            find_sources([path], list(cameras))
