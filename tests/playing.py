"""Cameras made of frames that are at hand: the thinnest stand-in for hardware, at the very edge."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from ipsys_log.messages import RigCamera
from ipsys_log.sources.frames import Clock, Frame, Open, Say

__all__ = ["cameras", "playing"]


def cameras(*names: str) -> list[RigCamera]:
    return [RigCamera(name, source=f"test:{name}") for name in names]


def playing(
    frames: Mapping[str, Sequence[bytes]],
    rate_hz: float,
    stamped: bool = True,
    before: Callable[[str, int], None] = lambda camera, number: None,
) -> Open:
    """Opens cameras that send their frames once, in real time; ``before`` is called before each frame.

    Frames of one number are sent at one time by all cameras, as of one world.
    """
    starts_s: dict[str, float] = {}

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            now_s = time.monotonic()
            start_s = now_s if camera.name in starts_s else min(starts_s.values(), default=now_s)
            starts_s[camera.name] = start_s
            for number, data in enumerate(frames[camera.name]):
                wait_s = start_s + number / rate_hz - time.monotonic()
                if wait_s > 0:
                    time.sleep(wait_s)
                before(camera.name, number)
                yield Frame(data, "jpeg", clock.now_ns() - 1_000_000 if stamped else None)

        yield sent()

    return opened
