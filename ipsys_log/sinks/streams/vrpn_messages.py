"""Messages of VRPN 07.38 (https://github.com/vrpn/vrpn): the greeting, descriptions and tracker reports.

A message has a header of six numbers: its length without padding, the seconds and microseconds of its time,
the ids of its sender and its type, and a count. Header and content are padded to multiples of eight bytes.
All numbers are big-endian. Each side numbers its own senders and types, and describes them by name.
"""

import struct
from typing import NamedTuple

from ipsys_log.sinks.streams.poses import StreamPose, Velocity
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import vector_quaternion

_ALIGNMENT = 8
_HEADER = struct.Struct(">IIIiiI")
_POSE = struct.Struct(">ii3d4d")
_VELOCITY = struct.Struct(">ii3d4dd")
# The version, then two spaces and the request to the other side to write no log.
GREETING = b"vrpn: ver. 07.38  0".ljust(24, b"\0")
GREETING_BYTES = len(GREETING)
_SAME_MAJOR = b"vrpn: ver. 07."
# Types of the protocol itself.
SENDER_DESCRIPTION, TYPE_DESCRIPTION, DISCONNECT = -1, -2, -5
# Types of this server; their ids are the places in this list.
TYPES = (
    b"vrpn_Tracker Pos_Quat",
    b"vrpn_Tracker Velocity",
    b"vrpn_Base ping_message",
    b"vrpn_Base pong_message",
)
_POS_QUAT, _VELOCITY_TYPE, PING, PONG = range(4)
# No message to a server of trackers is longer.
_LONGEST = 4096
# The rotation of a velocity is that of this time, in s.
_TURN_S = 0.1
_SENSOR = 0


class Received(NamedTuple):
    """A message of a client: the ids of its sender and its type, and its content."""

    sender: int
    type: int
    content: bytes

    @property
    def name(self) -> bytes:
        """The name in a description: its length, and a text that ends with zero."""
        return self.content[4:].partition(b"\0")[0]


def is_greeting(data: bytes) -> bool:
    """Return whether the other side speaks this version of the protocol."""
    return data.startswith(_SAME_MAJOR)


def pack(content: bytes, type_id: int, sender: int, time_ns: int, count: int) -> bytes:
    """Return the bytes of a message. The time must be after 1970 and before 2106."""
    seconds, rest_ns = divmod(time_ns, NS_PER_S)
    length = _HEADER.size + len(content)
    padding = bytes(-len(content) % _ALIGNMENT)
    return _HEADER.pack(length, seconds, rest_ns // 1000, sender, type_id, count) + content + padding


def describe(name: bytes, number: int, is_sender: bool, count: int) -> bytes:
    """Return the description of a sender or a type."""
    content = struct.pack(">i", len(name) + 1) + name + b"\0"
    return pack(content, SENDER_DESCRIPTION if is_sender else TYPE_DESCRIPTION, number, 0, count)


def pack_pose(pose: StreamPose, sender: int, count: int) -> bytes:
    """Return the messages of a pose with a rotation: the pose, and the velocity if it is known.

    The world has z up, x and y on the floor; lengths are in m.
    """
    track, velocity = pose.track, pose.velocity
    content = _POSE.pack(_SENSOR, 0, track.x_m, track.y_m, track.z_m, *pose.quaternion)
    message = pack(content, _POS_QUAT, sender, pose.time_ns, count)
    if velocity is None or velocity.yaw_rad_s is None:
        return message
    return message + pack(_velocity(velocity), _VELOCITY_TYPE, sender, pose.time_ns, count + 1)


def _velocity(velocity: Velocity) -> bytes:
    turn = vector_quaternion(velocity.turn_rad_s * _TURN_S)
    return _VELOCITY.pack(_SENSOR, 0, velocity.x_m_s, velocity.y_m_s, velocity.z_m_s, *turn, _TURN_S)


def take_message(buffer: bytearray) -> Received | None:
    """Remove the first message from a buffer and return it; None if it is not complete.

    Raises
    ------
    ValueError
        The buffer holds something else.
    """
    if len(buffer) < _HEADER.size:
        return None
    length, _, _, sender, type_id, _ = _HEADER.unpack_from(buffer)
    if not _HEADER.size <= length <= _LONGEST:
        raise ValueError(f"a message of {length} bytes")
    padded = length + -length % _ALIGNMENT
    if len(buffer) < padded:
        return None
    content = bytes(buffer[_HEADER.size : length])
    del buffer[:padded]
    return Received(sender, type_id, content)
