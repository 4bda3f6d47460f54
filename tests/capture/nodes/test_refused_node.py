"""A node that its centre refuses: its end, and what it tells the user."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path

from ipsys_log.capture.frames import Clock
from ipsys_log.capture.nodes.network import NodeNetwork
from ipsys_log.capture.nodes.node import Node
from ipsys_log.capture.nodes.wire import StateRequest
from ipsys_log.messages import CompressedImage, Message, image_topic
from ipsys_log.units import NS_PER_S
from tests.log.conftest import create

OTHER = "00112233445566ff"


class AskedClock(Clock):
    """A clock that goes on by a second at each look, while a centre asks for a session."""

    def __init__(self) -> None:
        super().__init__()
        self._seconds: Iterator[int] = count(1_000)
        self.node: Node | None = None
        self.session = ""

    def now_ns(self) -> int:
        now_ns = next(self._seconds) * NS_PER_S
        if self.node is not None:
            self.node._note_centre(StateRequest("0.1.0", self.session, 0), now_ns)
        return now_ns


def asked_node(
    folder: Path, session: str | None, sends_markers: bool = False
) -> tuple[Node, AskedClock, list[str]]:
    """Return a node with a frame, whose centre asks for a session; None: for that of the node."""
    clock, said = AskedClock(), list[str]()
    log = create(folder / "red.mcap", [(image_topic("red"), 1, 1, b"frame")])
    node = Node("red", NodeNetwork("127.0.0.1", 1), "0.1.0", log, clock, said.append, sends_markers)
    image = CompressedImage(1, "red", b"frame", "jpeg")
    node(Message(image_topic("red"), 1, 1, image, "red"))
    clock.node, clock.session = node, node.session_name if session is None else session
    return node, clock, said


def test_refused_node_ends_while_its_centre_asks(tmp_path: Path) -> None:
    """Ctrl-C had no effect on a second node of one name, as long as the centre recorded the first one."""
    node, _, said = asked_node(tmp_path, OTHER)
    assert node.finish(has_ended=False) == 1
    assert said == []


def test_node_of_another_version_ends_while_its_centre_asks(tmp_path: Path) -> None:
    node, _, _ = asked_node(tmp_path, "")
    assert node.finish(has_ended=True) == 1


def test_refused_node_says_so_once(tmp_path: Path) -> None:
    _, clock, said = asked_node(tmp_path, OTHER)
    for _ in range(30):
        clock.now_ns()
    assert said == [
        "the centre 127.0.0.1:1 receives camera red from another node, and refuses this one; end one of "
        "them, or give it another --camera"
    ]


def test_node_that_starts_again_is_not_called_refused(tmp_path: Path) -> None:
    """The centre asks for the session before, until it has accepted the new one."""
    node, clock, said = asked_node(tmp_path, OTHER)
    for session in (OTHER, OTHER, node.session_name, OTHER, node.session_name):
        clock.session = session
        for _ in range(4):
            clock.now_ns()
    assert said == ["the centre 127.0.0.1:1 receives the frames of camera red"]


def test_node_that_sends_markers_says_so(tmp_path: Path) -> None:
    node, clock, said = asked_node(tmp_path, None, sends_markers=True)
    clock.now_ns()
    assert said == ["the centre 127.0.0.1:1 receives the markers of camera red"]
    missing = "the centre 127.0.0.1:1 does not have the markers of 2 frames of camera red; red.mcap has all"
    assert node.describe_missing(2, Path("red.mcap")) == missing
