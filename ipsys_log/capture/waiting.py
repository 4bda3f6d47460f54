"""Frames that wait for the stages, and which of them are skipped where there are too many."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from ipsys_log.images.video import is_keyframe
from ipsys_log.messages import CompressedImage, CompressedVideo, Message, SkippedVideo

__all__ = ["Waiting"]

# Frames of a camera that may wait to be searched; older ones are skipped.
_SEARCHED = 3
# Frames of a video that may wait at all, most of them only to be decoded; that is a second or two.
_DECODED = 30


class Waiting:
    """Frames in the order they came, at most so many of each camera. For one thread, or under a lock.

    Of JPEG pictures the oldest is skipped. A frame of a video is needed by those after it: the oldest is
    still decoded, which takes half of the time, and not searched. Where that is too much as well, all
    frames up to the next keyframe are skipped.
    """

    def __init__(self) -> None:
        self._frames: deque[Message] = deque()
        # Cameras whose next frames are nothing without one that was skipped.
        self._broken: set[str | None] = set()

    def __len__(self) -> int:
        return len(self._frames)

    def take(self) -> list[Message]:
        """All that wait; those of a video that are not to be searched as :class:`SkippedVideo`."""
        taken = list(self._frames)
        self._frames.clear()
        return taken

    def put(self, message: Message) -> list[Message]:
        """Let a frame wait; returns those that are skipped for it, maybe itself."""
        if isinstance(message.payload, CompressedVideo):
            return self._put_video(message)
        self._frames.append(message)
        mine = self._of(message.camera)
        if not isinstance(message.payload, CompressedImage) or len(mine) <= _SEARCHED:
            return []
        self._frames.remove(mine[0])
        return [mine[0]]

    def _put_video(self, message: Message) -> list[Message]:
        if message.camera in self._broken:
            if not is_keyframe(message.payload):
                return [message]
            self._broken.remove(message.camera)
        self._frames.append(message)
        gone = self._jump(message.camera)
        mine = self._of(message.camera)
        searched = [one for one in mine if isinstance(one.payload, CompressedVideo)]
        if len(searched) <= _SEARCHED:
            return gone
        late, following = searched[:2]
        if is_keyframe(following.payload):
            self._leave_out(mine[: mine.index(following)])
        else:
            self._frames[self._frames.index(late)] = replace(late, payload=SkippedVideo(late.payload))
        return [*gone, late]

    def _jump(self, camera: str | None) -> list[Message]:
        """Where too many wait, go on with the newest keyframe, or with the next one; what is skipped."""
        mine = self._of(camera)
        if len(mine) <= _DECODED:
            return []
        keys = [n for n, one in enumerate(mine) if n and is_keyframe(_frame(one))]
        gone = mine[: keys[-1]] if keys else mine
        if not keys:
            self._broken.add(camera)
        self._leave_out(gone)
        return [one for one in gone if isinstance(one.payload, CompressedVideo)]

    def _of(self, camera: str | None) -> list[Message]:
        return [one for one in self._frames if one.camera == camera]

    def _leave_out(self, gone: list[Message]) -> None:
        times_ns = {one.log_time_ns for one in gone}
        self._frames = deque(one for one in self._frames if one.log_time_ns not in times_ns)


def _frame(message: Message) -> CompressedVideo:
    payload: CompressedVideo | SkippedVideo = message.payload
    return payload.frame if isinstance(payload, SkippedVideo) else payload
