"""Appends of messages to an open log."""

from pathlib import Path

import pytest

from ipsys_log.engine.output import write_messages
from ipsys_log.errors import LogError
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import CompressedImage, CompressedVideo, Message


def test_a_frame_of_another_schema_is_refused_by_its_topic(tmp_path: Path) -> None:
    topic = "/cameras/red/image"
    picture = Message(topic, 1, 1, CompressedImage(1, "red", b"\xff\xd8", "jpeg"), "red")
    video = Message(topic, 2, 2, CompressedVideo(2, "red", b"\0\0\1", "h264"), "red")
    with LogWriter.create(tmp_path / "a.mcap") as writer, pytest.raises(LogError, match="/cameras/red/image"):
        write_messages(writer, [picture, video])
