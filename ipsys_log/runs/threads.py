"""Cameras side by side on the cores."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import cv2

from ipsys_log.messages import Message

__all__ = ["in_threads"]


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
