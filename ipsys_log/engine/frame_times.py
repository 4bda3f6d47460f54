"""Log times of channels; those of images come from their markers, which lie together in a log.

The message indexes of images are spread over the whole log, one beside each chunk of images. A log at a URL
would need a request for each of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.provenance import complete_runs
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Run
from ipsys_log.messages.channels import MARKERS


def channel_times(session: Session, topic: str) -> NDArray[np.int64]:
    """Return the log times of the messages of a topic in ns, sorted, shape (N,).

    A derived message has the log time of the message that it was made from. So the times of images are those
    of their markers, if a complete run has read these images, and has a message for each of them.
    """
    source = _marker_topic(session, topic) if topic in session.images.values() else None
    wanted = source or topic
    readers = [reader for reader in session.readers if wanted in reader.channels]
    return np.sort(np.concatenate([reader.times(wanted) for reader in readers]))


def _marker_topic(session: Session, images: str) -> str | None:
    camera = next(name for name, topic in session.images.items() if topic == images)
    for run in reversed(complete_runs(session)):
        for topic in session.topics(MARKERS, run.run):
            written = any(output.topic == topic for output in run.outputs)
            if written and camera_of_topic(topic) == camera and _has_all(session, run, images, topic):
                return topic
    return None


def _has_all(session: Session, run: Run, images: str, markers: str) -> bool:
    """Return whether a run has read these images as they are now, and has a message for each of them."""
    count = session.count(images)
    hashes = [read.hash for read in run.inputs if (read.topic, read.messages) == (images, count)]
    readers = [reader for reader in session.readers if images in reader.channels]
    is_known = all(reader.has_stored_hash(images) for reader in readers)
    return session.count(markers) == count and is_known and session.hash(images) in hashes
