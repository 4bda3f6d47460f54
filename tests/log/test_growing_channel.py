"""Messages are readable by their number while the log is written."""

from contextlib import closing
from pathlib import Path

from ipsys_log.engine.output import write_message
from ipsys_log.log.growing_channel import GrowingChannel
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import EVENTS_TOPIC, CompressedImage, CompressedVideo, Event, Message, image_topic


def image(number: int, camera: str = "red") -> Message:
    payload = CompressedImage(1000 + number, camera, bytes([number]) * 700_000, "jpeg")
    return Message(image_topic(camera), 2000 + number, 1000 + number, payload, camera)


def test_images_are_found_as_soon_as_their_chunk_is_written(tmp_path: Path) -> None:
    path, counts = tmp_path / "a.mcap", dict[str, int]()
    with LogWriter.create(path) as log, closing(GrowingChannel(path, image_topic("red"))) as images:
        assert images.read(0) is None
        for number in range(16):
            write_message(log, image(number), counts)
            write_message(log, image(number, "white"), counts)
            write_message(log, Message(EVENTS_TOPIC, 2000 + number, 1, Event(1, "mark", "x")), counts)
        # The last chunk is not in the file yet.
        assert images.read(15) is None
        log.flush()
        for number in (15, 0, 7):
            assert images.read(number).data == bytes([number]) * 700_000
            assert images.read(number).timestamp == 1000 + number
    with closing(GrowingChannel(path, image_topic("red"))) as images:
        assert images.read(15).data == bytes([15]) * 700_000
        assert images.read(16) is None


def test_messages_of_compressed_chunks_are_found(tmp_path: Path) -> None:
    path, counts = tmp_path / "a.mcap", dict[str, int]()
    with LogWriter.create(path) as log, closing(GrowingChannel(path, EVENTS_TOPIC)) as events:
        for number in range(300):
            text = f"event {number} " * 20
            write_message(log, Message(EVENTS_TOPIC, 2000 + number, 1, Event(number, "mark", text)), counts)
            if number % 100 == 99:
                log.flush()
                assert events.read(number) == Event(number, "mark", text)
        assert events.read(3).timestamp == 3


def test_video_packets_are_found(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter.create(path) as log, closing(GrowingChannel(path, image_topic("red"))) as images:
        payload = CompressedVideo(5, "red", b"packet", "h264")
        write_message(log, Message(image_topic("red"), 9, 5, payload, "red"), {})
        log.flush()
        assert images.read(0).data == b"packet"
