"""The file of a recording is found after another program has renamed it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from ipsys_log.capture import disk
from ipsys_log.capture.disk import RecordedFile
from ipsys_log.capture.recorder import open_recording
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


def test_renamed_file_is_found(file: RecordedFile, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
    (tmp_path / "a.mcap").write_bytes(b"another file")
    assert not file.is_deleted
    assert file.find() == tmp_path / "b.mcap"


def test_new_name_keeps_the_form_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.mcap").write_bytes(b"data")
    opened = RecordedFile.open(Path("a.mcap"))
    assert opened is not None
    with closing(opened):
        Path("a.mcap").rename("b.mcap")
        assert opened.find() == Path("b.mcap")


@pytest.mark.parametrize("take", [Path.unlink, lambda path: path.with_name("other").replace(path)])
def test_deleted_or_replaced_file_is_deleted(
    file: RecordedFile, tmp_path: Path, take: Callable[[Path], None]
) -> None:
    (tmp_path / "other").write_bytes(b"another file")
    take(tmp_path / "a.mcap")
    assert file.is_deleted
    assert file.find() is None


def test_file_with_a_second_name_is_not_deleted(file: RecordedFile, tmp_path: Path) -> None:
    os.link(tmp_path / "a.mcap", tmp_path / "b.mcap")
    (tmp_path / "a.mcap").unlink()
    assert not file.is_deleted


def test_unknown_name_is_reported_and_the_log_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other systems than Linux do not tell the present name of an open file."""
    monkeypatch.setattr(disk, "_OPEN_FILES", tmp_path / "none")
    image = CompressedImage(1, "red", b"image", "jpeg")
    with open_recording(tmp_path / "a.mcap") as log:
        (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
        log.put(Message(image_topic("red"), 1, 1, image, "red"))
    log.check_disk()
    assert log.path is None
    assert log.describe_rename() == (
        f"another program has renamed the log {tmp_path / 'a.mcap'}: its present name cannot be found"
    )
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
