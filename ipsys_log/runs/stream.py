"""Messages through stages: one after the other, or with one thread for each camera."""

from __future__ import annotations

import builtins
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import cv2

from ipsys_log.messages import (
    CameraPoints,
    Evaluation,
    Event,
    FrameTransforms,
    ImageAnnotations,
    Markers,
    Message,
    Model,
    Positions,
    Tracks,
)

__all__ = ["TOPICS", "Stage", "in_threads", "run"]

# Where a payload goes within its run.
TOPICS: dict[type, str] = {
    Markers: "/runs/{run}/cameras/{camera}/markers",
    ImageAnnotations: "/runs/{run}/cameras/{camera}/annotations",
    CameraPoints: "/runs/{run}/cameras/{camera}/camera_points",
    Model: "/runs/{run}/model",
    Evaluation: "/runs/{run}/evaluation",
    Positions: "/runs/{run}/cameras/{camera}/positions",
    Tracks: "/runs/{run}/tracks",
    FrameTransforms: "/runs/{run}/poses",
    Event: "/runs/{run}/events",
}

Map = Callable[[Callable[[Message], Any], Iterable[Message]], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Stage:
    """A causal stage: the run it writes to, which payloads it reads, and its step.

    A stage that remembers something across cameras is not ``per_camera``: it takes one message after
    the other, whatever the map.
    """

    run: str
    reads: tuple[type, ...]
    step: Callable[[Message], Iterable[Any]]
    per_camera: bool = True


def run(source: Iterable[Message], stages: Sequence[Stage], map: Map = map) -> Iterator[Message]:
    """Send every message of a source through the stages, and yield it and what they make of it.

    What a stage makes has the log time of the message it was made from, and follows it at once; the
    next stage sees both. Its publish time is its own timestamp. With ``map`` as :func:`in_threads`,
    cameras use the cores in parallel and the order stays the same.
    """
    for stage in stages:
        source = _through(stage, source, map)
    yield from source


def _through(stage: Stage, source: Iterable[Message], map: Map) -> Iterator[Message]:
    def work(message: Message) -> tuple[Message, list[Any]]:
        return message, list(stage.step(message)) if isinstance(message.payload, stage.reads) else []

    for message, payloads in (map if stage.per_camera else builtins.map)(work, source):
        yield message
        for payload in payloads:
            topic = TOPICS[type(payload)].format(run=stage.run, camera=message.camera)
            # Transforms have their times one by one; drawings on a frame have that of the frame.
            stamped = payload.transforms[0] if isinstance(payload, FrameTransforms) else payload
            time_ns = getattr(stamped, "timestamp", message.publish_time_ns)
            yield Message(topic, message.log_time_ns, time_ns, payload, message.camera)


def in_threads(function: Callable[[Message], Any], messages: Iterable[Message]) -> Iterator[Any]:
    """``map`` with one thread per camera: a camera's messages stay in order, and so do the results.

    A message of no camera (the rig) concerns all of them: it waits for those before it. OpenCV's own
    threads are turned off meanwhile; one thread per camera uses the cores better.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pending: deque[Future[Any]] = deque()
    workers: dict[str, ThreadPoolExecutor] = {}
    with ExitStack() as stack:
        stack.callback(cv2.setNumThreads, threads)
        for message in messages:
            if message.camera is None:
                while pending:
                    yield pending.popleft().result()
                yield function(message)
                continue
            if message.camera not in workers:
                workers[message.camera] = stack.enter_context(ThreadPoolExecutor(1))
            pending.append(workers[message.camera].submit(function, message))
            # Enough ahead that no camera waits for another, and no more in memory than that.
            while len(pending) > 4 * len(workers):
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
