"""Streams of messages through stages: in one thread, or with one thread for each camera."""

import builtins
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2

from ipsys_log.log.contents import run_of_topic
from ipsys_log.messages import FrameTransforms, Message, kind_of
from ipsys_log.messages.channels import Channel, channel_of
from ipsys_log.messages.stage import Stage, Step

Map = Callable[[Callable[[Message], Any], Iterable[Message]], Iterable[Any]]


class Route(NamedTuple):
    """A channel of one run; the run is None for a recorded channel."""

    channel: Channel
    run: str | None


@dataclass(frozen=True, slots=True)
class WiredStage:
    """A causal stage in a stream: the run that it writes, the routes that it reads, and its step.

    A stage that combines cameras is not ``per_camera``: it processes one message after the other, with any
    ``map``.
    """

    stage: Stage
    run: str
    reads: frozenset[Route]
    step: Step

    def topic_of(self, payload: Any, camera: str | None) -> str:
        """Return the topic that a payload of this stage goes to."""
        return self.stage.channel_for(kind_of(payload)).topic_of(self.run, camera)


def wire(stage: Stage, run: str, inputs: Mapping[Channel, str], step: Step) -> WiredStage:
    """Wire a causal stage: it reads recorded channels of its row, and derived channels of ``inputs``."""
    reads = {
        Route(channel, inputs.get(channel, "") if channel.is_derived else None) for channel in stage.reads
    }
    return WiredStage(stage, run, frozenset(reads), step)


def run(source: Iterable[Message], stages: Sequence[WiredStage], map: Map = map) -> Iterator[Message]:
    """Send each message of a source through the stages; yield the message and the messages made from it.

    A derived message has the log time of its source message and follows it at once; the next stage sees
    both. Its publish time is its own timestamp. With ``map`` as :func:`in_threads`, cameras use the cores in
    parallel and the order stays the same.
    """
    for stage in stages:
        source = _through(stage, source, map)
    yield from source


def _through(wired: WiredStage, source: Iterable[Message], map: Map) -> Iterator[Message]:
    is_read: dict[tuple[str, type], bool] = {}

    def work(message: Message) -> tuple[Message, list[Any]]:
        key = message.topic, type(message.payload)
        if key not in is_read:
            channel = channel_of(*key)
            is_read[key] = channel is not None and Route(channel, run_of_topic(message.topic)) in wired.reads
        return message, list(wired.step(message)) if is_read[key] else []

    for message, payloads in (map if wired.stage.per_camera else builtins.map)(work, source):
        yield message
        yield from derive(wired, message, payloads)


def derive(wired: WiredStage, message: Message, payloads: Iterable[Any]) -> Iterator[Message]:
    """Yield the messages with the payloads that a stage has made from a message."""
    for payload in payloads:
        # Each transform has its own time; drawings on an image have the time of the image.
        stamped = payload.transforms[0] if isinstance(payload, FrameTransforms) else payload
        time_ns = getattr(stamped, "timestamp", message.publish_time_ns)
        topic = wired.topic_of(payload, message.camera)
        yield Message(topic, message.log_time_ns, time_ns, payload, message.camera)


def in_threads(function: Callable[[Message], Any], messages: Iterable[Message]) -> Iterator[Any]:
    """Apply a function like ``map``, with one thread per camera; keep the order of messages and results.

    A message of no camera (the rig) concerns all cameras: it waits for the messages before it. OpenCV's own
    threads are turned off during this time; one thread per camera uses the cores better.
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
            # This queue is long enough that no camera waits for another, and it limits the memory.
            while len(pending) > 4 * len(workers):
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
