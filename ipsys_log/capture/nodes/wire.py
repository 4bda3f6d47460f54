"""The messages between the nodes and the centre: their keys, and their conversion to bytes.

A node sends each frame with a header. The centre asks a node for its state, which is also an exchange of
times, and for frames that did not arrive. All messages are untrusted: a message that is not valid reads as
None.
"""

import json
import re
import struct
from typing import Any, NamedTuple, Self, TypeVar, get_type_hints

_PREFIX = "ipsys"
_HEADER = struct.Struct("<4s8sQqB")
_MAGIC = b"ips1"
# The format of the markers of a frame, which are sent instead of the frame.
MARKERS_FORMAT = "markers"
FORMATS = ("jpeg", "png", "h264", "h265", MARKERS_FORMAT)
_SESSION = re.compile(r"[0-9a-f]{16}")
_LONGEST_TEXT = 4096
_LARGEST_INT = 1 << 62
_LONGEST_VERSION = 60


def frames_key(camera: str) -> str:
    """Return the key of the frames that a node sends.

    Examples
    --------
    >>> frames_key("red")
    'ipsys/red/frames'
    """
    return f"{_PREFIX}/{camera}/frames"


def state_key(camera: str) -> str:
    """Return the key of the requests for the state of a node."""
    return f"{_PREFIX}/{camera}/state"


def missing_key(camera: str) -> str:
    """Return the key of the requests for frames that did not arrive."""
    return f"{_PREFIX}/{camera}/missing"


class FrameHeader(NamedTuple):
    """The header of a frame.

    ``number`` counts the frames of a session from 0. ``time_ns`` is the time of the frame by the clock of the
    node: the middle of its exposure.
    """

    session: str
    number: int
    time_ns: int
    format: str

    def encode(self) -> bytes:
        """Return the bytes of the header."""
        session = bytes.fromhex(self.session)
        return _HEADER.pack(_MAGIC, session, self.number, self.time_ns, FORMATS.index(self.format))

    @classmethod
    def decode(cls, data: bytes) -> Self | None:
        """Return the header in some bytes; None if they are none.

        Examples
        --------
        >>> header = FrameHeader("00112233445566ff", 7, 1_500, "jpeg")
        >>> FrameHeader.decode(header.encode()) == header, FrameHeader.decode(b"else")
        (True, None)
        """
        if len(data) != _HEADER.size:
            return None
        magic, session, number, time_ns, kind = _HEADER.unpack(data)
        is_valid = magic == _MAGIC and kind < len(FORMATS) and number < _LARGEST_INT
        return cls(session.hex(), number, time_ns, FORMATS[kind]) if is_valid else None


class StateRequest(NamedTuple):
    """A request of the centre for the state of a node.

    ``version`` is that of ipsys at the centre. ``session`` is the session whose frames the centre has, and
    ``received`` the number of its first frame that the centre still needs.
    """

    version: str
    session: str
    received: int


class NodeState(NamedTuple):
    """The answer of a node: its version, its session, and the times of the exchange by its clock.

    ``recorded`` is the number of its frames so far. ``has_ended``: the source of the frames has ended.
    """

    version: str
    session: str
    received_ns: int
    replied_ns: int
    recorded: int
    has_ended: bool


class FrameRequest(NamedTuple):
    """A request for frames of a session, from the number ``first`` to the number before ``end``."""

    session: str
    first: int
    end: int


Text = TypeVar("Text", StateRequest, NodeState, FrameRequest)


def encode_text(message: StateRequest | NodeState | FrameRequest) -> bytes:
    """Return a message as JSON."""
    return json.dumps(message._asdict()).encode()


def decode_text(kind: type[Text], data: bytes) -> Text | None:
    """Return the message of a kind in some bytes of JSON; None if they are none.

    Examples
    --------
    >>> state = NodeState("0.1.0", "00112233445566ff", 5, 6, 2, False)
    >>> decode_text(NodeState, encode_text(state)) == state, decode_text(NodeState, b"{}")
    (True, None)
    """
    if len(data) > _LONGEST_TEXT:
        return None
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        return None
    types = get_type_hints(kind)
    if not isinstance(values, dict) or values.keys() != types.keys():
        return None
    is_valid = all(_is_valid(name, value, types[name]) for name, value in values.items())
    return kind(**values) if is_valid else None


def _is_valid(name: str, value: Any, kind: type) -> bool:
    if type(value) is not kind:
        return False
    if isinstance(value, str):
        if name == "session":
            return value == "" or _SESSION.fullmatch(value) is not None
        return len(value) <= _LONGEST_VERSION and value.isprintable()
    return not isinstance(value, int) or 0 <= value < _LARGEST_INT
