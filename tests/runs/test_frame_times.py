"""Times of images from their markers: the same as from the indexes of the images."""

from pathlib import Path

import numpy as np
import pytest

from ipsys_log.engine.provenance import channel_times
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader


def test_times_of_all_channels_are_those_of_their_indexes(detected_log: Path) -> None:
    with Session([detected_log]) as session:
        (reader,) = session.readers
        for topic in reader.channels:
            assert np.array_equal(channel_times(session, topic), reader.times(topic))


def test_indexes_of_images_are_read_only_without_markers(
    detected_log: Path, lab_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, asked = LogReader.times, []

    def times(reader: LogReader, topic: str) -> object:
        asked.append(topic)
        return read(reader, topic)

    monkeypatch.setattr(LogReader, "times", times)
    for log, reads_images in ((detected_log, False), (lab_log, True)):
        asked.clear()
        with Session([log]) as session:
            topic = session.images["red"]
            assert len(channel_times(session, topic)) == session.count(topic)
            assert (topic in asked) is reads_images
