"""The process that receives the frames of nodes: its frames, its end, and its faults."""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path

import pytest

from ipsys_log.capture.devices import open_source
from ipsys_log.capture.frames import Clock, SourceError
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.nodes.network import NodeNetwork
from ipsys_log.capture.nodes.receiver import Receiver, _Setup, serve
from ipsys_log.engine.piped_process import PipedProcess
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CompressedImage, Event, RigCamera
from tests.capture.nodes.lab_of_nodes import PATIENCE_S, Feed, sending
from tests.ports import free_port
from tests.waiting import wait_until

VERSION = "0.1.0"


def cameras(*names: str) -> list[RigCamera]:
    return [RigCamera(name, source=f"zenoh:{name}") for name in names]


def local() -> NodeNetwork:
    return NodeNetwork("127.0.0.1", free_port())


@contextmanager
def sending_always(folder: Path, network: NodeNetwork, *names: str) -> Iterator[dict[str, Feed]]:
    """Open nodes that record a frame 20 times a second."""
    ended = threading.Event()

    def work(feeds: list[Feed]) -> None:
        while not ended.wait(0.05):
            for feed in feeds:
                feed.record(1)

    with ExitStack() as stack:
        feeds = {name: stack.enter_context(sending(folder, network, name)) for name in names}
        thread = threading.Thread(target=work, args=(list(feeds.values()),))
        thread.start()
        stack.callback(thread.join)
        stack.callback(ended.set)
        yield feeds


@pytest.mark.slow
def test_frames_pass_and_end_with_their_node(tmp_path: Path) -> None:
    network = local()
    made, recorded = list[bytes](), list[bytes]()

    def say(text: str) -> None:
        if "its node answers" in text:
            feed.record(1)

    with (
        Receiver(cameras("red"), network, VERSION) as receiver,
        sending(tmp_path, network) as feed,
        ThreadPoolExecutor(1) as thread,
        LiveCameras(cameras("red"), receiver.choose_opener(open_source), Clock(), say) as live,
    ):
        for message in live:
            if not made:
                made += feed.record(50)
                thread.submit(feed.node.finish, has_ended=True)
            if message is not None and isinstance(message.payload, CompressedImage):
                recorded.append(message.payload.data)
    assert recorded == made


@pytest.mark.slow
def test_recording_goes_on_after_the_end_of_the_process(tmp_path: Path) -> None:
    """The system ends a process if memory lacks. A new process receives the frames from then on."""
    network, names = local(), ("red", "white")
    events, senders = list[Event](), set[str]()
    with (
        Receiver(cameras(*names), network, VERSION) as receiver,
        sending_always(tmp_path, network, *names),
        LiveCameras(cameras(*names), receiver.choose_opener(open_source), Clock()) as live,
    ):
        messages = iter(live)

        def wait(condition: Callable[[], bool], name: str) -> None:
            """Take messages until a condition holds."""

            def is_met() -> bool:
                for message in islice(messages, 20):
                    if message is not None and isinstance(message.payload, Event):
                        events.append(message.payload)
                    elif message is not None and isinstance(message.payload, CompressedImage):
                        senders.add(message.payload.frame_id)
                return condition()

            wait_until(is_met, name, lambda: f"frames of {senders}, {events}")

        def cameras_with(kind: str) -> set[str | None]:
            return {event.camera for event in events if event.kind == kind}

        wait(lambda: senders == set(names), "frames of both cameras arrive")
        assert receiver._process is not None
        first = receiver._process.process
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
        wait(lambda: cameras_with("camera_lost") == set(names), "both cameras are lost")
        wait(lambda: cameras_with("camera_back") == set(names), "both cameras are back in a new process")
        senders.clear()
        wait(lambda: senders == set(names), "the new process passes on frames of both cameras")
        live.stop()
    lost = [event for event in events if event.kind == "camera_lost"]
    assert {event.camera for event in lost} == set(names)
    assert all("the process that receives its frames has ended by signal 9" in event.text for event in lost)


def test_process_ends_with_the_pipe_of_its_recording() -> None:
    process = PipedProcess(serve)
    process.sender.send(_Setup((*cameras("red"),), local(), VERSION))
    assert process.receiver.recv() is None
    process.close()
    assert process.process.wait(PATIENCE_S) == 0


def test_port_in_use_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        network = NodeNetwork("127.0.0.1", other.getsockname()[1])
        receiver = Receiver(cameras("red"), network, VERSION)
        with pytest.raises(IpsysError, match=str(network.port)) as caught, receiver:
            pass
    assert "\n" not in str(caught.value)


def test_interrupt_ends_the_wait_for_a_node() -> None:
    network = local()
    with (
        Receiver(cameras("red"), network, VERSION, lambda: True) as receiver,
        pytest.raises(SourceError, match="no node red"),
        LiveCameras(cameras("red"), receiver.choose_opener(open_source), Clock()),
    ):
        pass
