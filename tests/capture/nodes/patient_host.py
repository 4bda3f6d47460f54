"""A command of ipsys with a given clock, and with limits for a busy machine.

Its cameras on USB are replaced: each frame is different, so tests can tell them apart::

    python -m tests.capture.nodes.patient_host UTC_MINUS_MONOTONIC_NS COMMAND [OPTIONS]
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

import numpy as np
import simplejpeg

from ipsys_log.app.cli import main
from ipsys_log.capture import camera_thread
from ipsys_log.capture.devices import OPENERS
from ipsys_log.capture.frames import Clock, Frame, Say
from ipsys_log.capture.nodes import centre, node
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S

PATIENCE_S, PERIOD_S = 600.0, 0.05
_COMMENT = b"\xff\xfe\x00\x0a"


@contextmanager
def _open_numbered(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame]]:
    """Open a camera whose JPEG frames have their number as a comment; an :data:`Open`."""
    size = camera.height or 0, camera.width or 0, 3
    image = simplejpeg.encode_jpeg(np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8))

    def play() -> Iterator[Frame]:
        for number in count():
            time.sleep(PERIOD_S)
            data = image[:2] + _COMMENT + number.to_bytes(8, "big") + image[2:]
            yield Frame(data, "jpeg", clock.now_ns())

    yield play()


def _run(offset_ns: int) -> None:
    anchor = Clock.__init__

    def start(clock: Clock) -> None:
        anchor(clock)
        clock._offset_ns = offset_ns

    Clock.__init__ = start  # type: ignore[method-assign, assignment]
    OPENERS["usb"] = _open_numbered
    node._SILENT_NS = round(PATIENCE_S * NS_PER_S)
    centre._FIRST_ANSWER_S = camera_thread._DRAW_S = PATIENCE_S
    main()


if __name__ == "__main__":
    _run(int(sys.argv.pop(1)))
