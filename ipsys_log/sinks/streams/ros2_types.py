"""The message types of ROS 2: their objects, their serialisation (CDR) and their definitions."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_typestore

from ipsys_log.units import NS_PER_S

# Jazzy and Kilted have the same definitions of these messages.
_STORE = get_typestore(Stores.ROS2_JAZZY)
_LAST_S = 2**31


def type_hash(ros_type: str) -> str:
    """Return the hash of a message type (REP 2016), ``RIHS01_`` and 64 characters."""
    return str(_STORE.hash_rihs01(ros_type))


def text_of(ros_type: str) -> str:
    """Return the definition of a message type with all types that it contains, as in a bag (``ros2msg``)."""
    return str(_STORE.generate_msgdef(ros_type, ros_version=2)[0])


def is_stampable(time_ns: int) -> bool:
    """Return whether a stamp of ROS 2 can hold a time: it ends in 2038."""
    return 0 <= time_ns < _LAST_S * NS_PER_S


def message_class(ros_type: str) -> Any:
    """Return the class of a message type, with its constants."""
    return _STORE.types[ros_type]


def make(name: str, *values: Any) -> Any:
    """Return a message of a type such as ``std_msgs/Header``, with the values of its fields."""
    return _class_of(name)(*values)


@cache
def _class_of(name: str) -> Any:
    package, _, short = name.partition("/")
    return message_class(f"{package}/msg/{short}")


def encode(message: Any, ros_type: str) -> bytes:
    """Return the bytes of a message."""
    return bytes(_STORE.serialize_cdr(message, ros_type))


def make_time(time_ns: int) -> Any:
    """Return the stamp of a time in ns."""
    return make("builtin_interfaces/Time", *divmod(time_ns, NS_PER_S))


def make_header(time_ns: int, frame: str) -> Any:
    """Return the header of a message: its stamp, and its coordinate frame."""
    return make("std_msgs/Header", make_time(time_ns), frame)
