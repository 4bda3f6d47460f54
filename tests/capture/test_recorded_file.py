"""A recording whose file another program renames or deletes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from ipsys_log.capture.disk import RecordedFile
from ipsys_log.capture.recorder import open_recording
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.growing_channel import GrowingChannel
from ipsys_log.messages import CompressedImage, Message, image_topic


@pytest.fixture
def file(tmp_path: Path) -> Iterator[RecordedFile]:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"data")
    opened = RecordedFile.open(path)
    assert opened is not None
    with closing(opened):
        yield opened


def test_renamed_file_is_not_deleted(file: RecordedFile, tmp_path: Path) -> None:
    assert not file.is_renamed
    (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
    (tmp_path / "a.mcap").write_bytes(b"another file")
    assert (file.is_deleted, file.is_renamed) == (False, True)


@pytest.mark.parametrize("take", [Path.unlink, lambda path: path.with_name("other").replace(path)])
def test_deleted_or_replaced_file_is_deleted(
    file: RecordedFile, tmp_path: Path, take: Callable[[Path], None]
) -> None:
    (tmp_path / "other").write_bytes(b"another file")
    take(tmp_path / "a.mcap")
    assert file.is_deleted


def test_file_with_a_second_name_is_not_deleted(file: RecordedFile, tmp_path: Path) -> None:
    os.link(tmp_path / "a.mcap", tmp_path / "b.mcap")
    (tmp_path / "a.mcap").unlink()
    assert not file.is_deleted


def test_renamed_log_is_whole_and_named(tmp_path: Path) -> None:
    image = CompressedImage(1, "red", b"image", "jpeg")
    with open_recording(tmp_path / "a.mcap") as log:
        (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
        log.put(Message(image_topic("red"), 1, 1, image, "red"))
    with pytest.raises(IpsysError, match="another program has renamed the log"):
        log.check_disk()
    with Session([tmp_path / "b.mcap"]) as session:
        assert [bytes(taken.data) for taken in session.payloads([image_topic("red")])] == [image.data]


def test_growing_log_is_read_after_its_rename(tmp_path: Path) -> None:
    """A node reads the frames that its centre requests, also from a renamed log."""
    path, image = tmp_path / "a.mcap", CompressedImage(1, "red", b"image", "jpeg")
    with open_recording(path) as log, closing(GrowingChannel(path, image_topic("red"))) as images:
        path.rename(tmp_path / "b.mcap")
        log.put(Message(image_topic("red"), 1, 1, image, "red"))
        log.flush()
        assert images.read(0).data == image.data
