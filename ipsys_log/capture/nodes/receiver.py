"""The process that receives the frames of nodes for a recording.

With many nodes, the threads of Zenoh would take the time of the thread that computes the positions: Python
runs one of them at a time. The process passes on all arrivals together, up to a thousand times a second.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, Self

from ipsys_log.capture.frames import Clock, Frame, Open, Say, SourceError, SourceMessage
from ipsys_log.capture.nodes.centre import Centre, describe_no_answer, is_of_node
from ipsys_log.capture.nodes.network import NodeNetwork
from ipsys_log.engine.piped_process import PipedProcess, parent_pipe
from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S

_LEAST_PERIOD_S, _MOST_PERIOD_S, _PERIOD_OF_NODE_S = 0.001, 0.005, 0.0002
# The readers of all cameras ask one after the other. One look at the pipe is enough for all of them.
_LOOK_EVERY_NS = NS_PER_S // 1000


def passing_period_s(nodes: int) -> float:
    """Return the period of passing on arrivals, in s. A longer one for many nodes lets more come together."""
    return min(max(nodes * _PERIOD_OF_NODE_S, _LEAST_PERIOD_S), _MOST_PERIOD_S)


class _End(NamedTuple):
    """The end of the frames of a camera."""


# A frame, a message about frames, a line for the user, or the end; an error also ends the frames.
_Item = Frame | SourceMessage | str | _End | Exception


class _Setup(NamedTuple):
    """The first message to the process."""

    cameras: tuple[RigCamera, ...]
    network: NodeNetwork
    version: str


class Receiver:
    """The cameras of nodes, received in a process of its own. A context manager.

    Parameters
    ----------
    cameras : cameras whose source is a node.
    network : the address and the certificates.
    version : the version of ipsys here; a node with another version is refused.
    is_stopped : ends the wait for the first answer of a node.

    Raises
    ------
    IpsysError
        On entering: the centre cannot listen.
    """

    def __init__(
        self,
        cameras: Sequence[RigCamera],
        network: NodeNetwork,
        version: str,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self._setup = _Setup(tuple(cameras), network, version)
        self._is_stopped = is_stopped
        self._process: PipedProcess | None = None
        self._arrived: dict[str, deque[_Item]] = {camera.name: deque() for camera in cameras}
        self._clock, self._looked_ns = Clock(), 0

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def choose_opener(self, other: Open) -> Open:
        """Return the function that opens the cameras of nodes, and with ``other`` all other cameras."""

        def choose(camera: RigCamera, clock: Clock, say: Say) -> Any:
            return self.open(camera, clock, say) if is_of_node(camera) else other(camera, clock, say)

        return choose

    @contextmanager
    def open(
        self, camera: RigCamera, clock: Clock, say: Say
    ) -> Iterator[Iterator[Frame | SourceMessage | None]]:
        """Open the camera of a node; an :data:`~ipsys_log.capture.frames.Open`.

        The iterator never waits: it yields None if nothing has arrived. One thread reads all cameras.

        Raises
        ------
        SourceError
            In the iteration: no node answers, the node has another version, two nodes have the name, or the
            receiving process has ended.
        """
        yield self._items(camera, clock, say)

    def _items(self, camera: RigCamera, clock: Clock, say: Say) -> Iterator[Frame | SourceMessage | None]:
        arrived, has_answered = self._arrived[camera.name], False
        arrived.clear()
        self._send(camera.name, clock)
        while True:
            if not arrived:
                self._look()
            if not arrived:
                if not has_answered and self._is_stopped():
                    raise SourceError(describe_no_answer(camera, self._setup.network))
                yield None
                continue
            item = arrived.popleft()
            if isinstance(item, _End):
                return
            if isinstance(item, Exception):
                raise item
            if isinstance(item, str):
                say(item)
                continue
            has_answered = True
            yield item

    def _look(self) -> None:
        """Take what has arrived since the last look, for all cameras."""
        now_ns = self._clock.now_ns()
        if now_ns - self._looked_ns < _LOOK_EVERY_NS:
            return
        self._looked_ns = now_ns
        try:
            while self._process is not None and self._process.receiver.poll():
                for camera, item in self._process.receiver.recv():
                    self._arrived[camera].append(item)
        except (EOFError, OSError):
            self._fail()

    def _send(self, camera: str, clock: Clock) -> None:
        """Request a camera of the process, and start the process again if it has ended."""
        if self._process is None:
            try:
                self._start()
            except IpsysError as error:
                raise SourceError(str(error)) from error
        assert self._process is not None
        try:
            self._process.sender.send((camera, clock))
        except OSError:
            self._fail()

    def _fail(self) -> None:
        """Give each camera the error that the process has ended."""
        assert self._process is not None
        how = self._process.describe_end()
        self._end()
        for camera, arrived in self._arrived.items():
            text = f"camera {camera}: the process that receives its frames has ended {how}"
            arrived.append(SourceError(text))

    def _start(self) -> None:
        try:
            self._process = PipedProcess(serve)
            self._process.sender.send(self._setup)
            fault = self._process.receiver.recv()
        except (EOFError, OSError) as error:
            self._end()
            raise IpsysError(
                f"the process that receives frames of nodes cannot be started ({error})"
            ) from error
        if fault is not None:
            self._end()
            raise fault

    def _end(self) -> None:
        if self._process is not None:
            process, self._process = self._process, None
            process.stop()


def serve() -> None:
    """Receive frames of nodes until the pipe to the parent ends. The main function of the process."""
    receiver, sender = parent_pipe()
    try:
        _serve(receiver, sender)
    except (EOFError, ConnectionError):
        os._exit(0)  # the process of the recording has ended


def _serve(receiver: Connection, sender: Connection) -> None:
    setup: _Setup = receiver.recv()
    with ExitStack() as stack:
        try:
            centre = stack.enter_context(Centre(setup.cameras, setup.network, setup.version))
        except IpsysError as error:
            sender.send(error)
            return
        sender.send(None)
        _pass_on(centre, {camera.name: camera for camera in setup.cameras}, receiver, sender)


def _pass_on(
    centre: Centre, cameras: Mapping[str, RigCamera], receiver: Connection, sender: Connection
) -> None:
    """Pass on all arrivals of the open cameras, once in each period."""
    opened: dict[str, Iterator[_Item | None]] = {}
    while True:
        while receiver.poll():
            name, clock = receiver.recv()
            opened[name] = _items_of(centre, cameras[name], clock)
        arrived = [
            (name, item)
            for name, items in opened.items()
            for item in iter(partial(next, items, None), None)  # at None, nothing more has arrived
        ]
        if arrived:
            sender.send(arrived)
        time.sleep(passing_period_s(len(cameras)))


def _items_of(centre: Centre, camera: RigCamera, clock: Clock) -> Iterator[_Item | None]:
    """Yield what arrives for a camera, the lines for the user, and the error that ends it."""
    said: deque[str] = deque()
    try:
        with centre.open(camera, clock, said.append) as items:
            for item in items:
                while said:
                    yield said.popleft()
                yield item
        yield _End()
    except Exception as error:
        yield error
