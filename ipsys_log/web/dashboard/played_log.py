"""A log that is played: the states of its cameras, counted from its messages, and its playback as JSON."""

from __future__ import annotations

from typing import Any

from ipsys_log.capture.camera_thread import CameraState
from ipsys_log.messages import CompressedImage, CompressedVideo, Event, Latency, Message, RawImage
from ipsys_log.player import Player
from ipsys_log.sinks.played_topics import PlayedScene
from ipsys_log.sinks.streams.poses import NewSession
from ipsys_log.units import NS_PER_S
from ipsys_log.web.dashboard.pictures import EVERY_NS

# Events that end and begin the state `up` of a camera.
_UP_AFTER = {"camera_lost": False, "camera_back": True}


class PlayedLog:
    """The playback of a log.

    Parameters
    ----------
    player : plays the log.
    scene : the constant parts of the log.

    Attributes
    ----------
    states : states of the cameras, by name. A log does not tell the number of dropped frames.
    """

    def __init__(self, player: Player, scene: PlayedScene) -> None:
        self.states = {name: CameraState(up=True) for name in scene.cameras}
        self._player, self._name = player, scene.name

    def count(self, message: Message) -> None:
        """Update the state of a camera by a message: its frames, its delay, and its losses."""
        payload = message.payload
        if isinstance(payload, NewSession):
            for begun in self.states.values():
                begun.up, begun.delay_s = True, None
        name = payload.camera if isinstance(payload, (Event, Latency)) else message.camera
        state = self.states.get(str(name))
        if state is None:
            return
        if isinstance(payload, (CompressedImage, CompressedVideo, RawImage)):
            state.frames += 1
        elif isinstance(payload, Latency):
            state.delay_s = (payload.received - payload.timestamp) / NS_PER_S
        elif isinstance(payload, Event):
            state.up = _UP_AFTER.get(payload.kind, state.up)

    def describe(self) -> dict[str, Any]:
        """Return the state of the playback: its position in the log, its rate, and its pause."""
        player = self._player
        return {
            "file": self._name,
            "seconds": round(max(player.position_s, 0.0), 1),
            "of_seconds": round(player.duration_s, 1),
            "rate": player.rate,
            "is_paused": player.is_paused,
            "loops": player.loop,
        }

    def picture_every_ns(self) -> int:
        """Return the shortest time between two pictures: each one in a pause, else five in a real second."""
        return 0 if self._player.is_paused else round(EVERY_NS * self._player.rate)
