"""Events of a live recording for cameras that were knocked."""

from __future__ import annotations

from ipsys_log.analysis.knocks import KnockMonitor
from ipsys_log.capture.recorder import Source
from ipsys_log.messages import CAMERA_MOVED, Message, Rig


class KnockEvents:
    """A consumer of live results that adds an event, and prints its text, when a camera has moved.

    The event is recorded and never derived: a replay does not repeat it, and no stage reads it.

    Parameters
    ----------
    cameras : the source of the recording; it gets the events.
    """

    def __init__(self, cameras: Source) -> None:
        self._cameras = cameras
        self._monitor: KnockMonitor | None = None

    def __call__(self, message: Message | None) -> None:
        """Handle one message; the rig comes first."""
        if message is None:
            return
        if isinstance(message.payload, Rig):
            self._monitor = KnockMonitor(message.payload)
        elif self._monitor is not None:
            for knock in self._monitor(message):
                self._cameras.add_event(CAMERA_MOVED, knock.text, knock.camera)
