"""Publishers of ROS 2 over Zenoh, as ``rmw_zenoh_cpp`` writes them, without ROS.

A publisher has a key expression with the topic, the type and the hash of the type; a liveliness token, by
which other nodes find it; and an attachment to each message.

References: ``docs/design.md``, ``liveliness_utils.cpp``, ``attachment_helpers.cpp`` and
``rmw_publisher_data.cpp`` of https://github.com/ros2/rmw_zenoh (branches jazzy and kilted).
"""

import json
import struct
import threading
from dataclasses import dataclass
from typing import Any

import xxhash
import zenoh
from zenoh import ext

from ipsys_log.sinks.streams.addresses import LOOPBACK

_ADMIN_SPACE = "@ros2_lv"
_GID_BYTES = 16
_HEARTBEAT_S = 0.5
# More sessions are refused; a lab has fewer nodes.
_MOST_SESSIONS = 64
_OPEN_TIMEOUT_MS = 3000


@dataclass(frozen=True, slots=True)
class Qos:
    """The quality of service of a publisher, as far as it differs from publisher to publisher.

    Attributes
    ----------
    depth : the number of messages that a receiver keeps.
    is_reliable : lost messages are sent again.
    is_latched : a later subscriber gets the last message (transient local).
    """

    depth: int = 10
    is_reliable: bool = True
    is_latched: bool = False

    def __str__(self) -> str:
        """Return the text in a token: reliability, durability, history and depth; empty: default."""
        reliability, durability = "" if self.is_reliable else "2", "1" if self.is_latched else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


@dataclass(frozen=True, slots=True)
class Entity:
    """A node in the graph of ROS 2, without namespace and enclave.

    Attributes
    ----------
    domain : the domain ID.
    session : the id of the Zenoh session, in hex.
    node : the name of the node.
    """

    domain: int
    session: str
    node: str

    def node_token(self) -> str:
        """Return the liveliness token of the node."""
        return f"{_ADMIN_SPACE}/{self.domain}/{self.session}/0/0/NN/%/%/{self.node}"

    def publisher_token(self, number: int, topic: str, ros_type: str, type_hash: str, qos: Qos) -> str:
        """Return the liveliness token of a publisher; its number is unique in the session."""
        return (
            f"{_ADMIN_SPACE}/{self.domain}/{self.session}/0/{number}/MP/%/%/{self.node}/"
            f"{topic.replace('/', '%')}/{_type_name(ros_type)}/{type_hash}/{qos}"
        )


def topic_key(domain: int, topic: str, ros_type: str, type_hash: str) -> str:
    """Return the key expression of the messages of a topic.

    Examples
    --------
    >>> topic_key(0, "/tf", "tf2_msgs/msg/TFMessage", "RIHS01_e3")
    '0/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e3'
    """
    return f"{domain}/{topic.strip('/')}/{_type_name(ros_type)}/{type_hash}"


def _type_name(ros_type: str) -> str:
    package, _, name = ros_type.split("/")
    return f"{package}::msg::dds_::{name}_"


def gid(token: str) -> bytes:
    """Return the identifier of a publisher, 16 bytes: the XXH3 hash of its token, little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(_GID_BYTES, "little")


def attachment(sequence: int, time_ns: int, publisher_gid: bytes) -> bytes:
    """Return the attachment of a message, 33 bytes; the first sequence number is 1."""
    return struct.pack("<qqB", sequence, time_ns, _GID_BYTES) + publisher_gid


def configure(domain: int, port: int, host: str | None = None, is_router: bool = True) -> zenoh.Config:
    """Return the configuration of a session that only sends.

    As a router, it listens on the port. Else it is a client of the router there, and listens nowhere. No
    message comes in or passes through, whatever another session sends.

    ``host`` is the address to listen on; None: only this machine.
    """
    endpoint = f"tcp/{_bracketed(host or LOOPBACK)}:{port}"
    settings: dict[str, Any] = {
        "mode": "router" if is_router else "client",
        "listen/endpoints": [endpoint] if is_router else [],
        "connect/endpoints": [] if is_router else [endpoint],
        "scouting/multicast/enabled": False,
        # Tells nodes the addresses of each other; they then connect directly.
        "scouting/gossip/enabled": is_router,
        "scouting/gossip/autoconnect": {"router": [], "peer": []},
        "adminspace/enabled": False,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_sessions": _MOST_SESSIONS,
        "transport/unicast/open_timeout": _OPEN_TIMEOUT_MS,
        # A slow subscriber must not delay the sender.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "access_control": _access(domain),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _access(domain: int) -> dict[str, Any]:
    """Return rules by which messages only leave, and other sessions only ask for them."""
    leaving = ["put", "reply", "liveliness_token", "declare_queryable"]
    asking = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
    keys = [f"{domain}/**", f"{_ADMIN_SPACE}/**", f"{domain}/**/@adv/**"]

    def allow(name: str, flow: str, messages: list[str]) -> dict[str, Any]:
        rule = {"id": name, "permission": "allow", "flows": [flow]}
        return {**rule, "messages": messages, "key_exprs": keys}

    # A client asks its router for the tokens of others.
    rules = [allow("send", "egress", [*leaving, "liveliness_query"]), allow("ask", "ingress", asking)]
    rules.append(allow("answer", "ingress", ["liveliness_token"]))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": "all"}],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": ["all"]}],
    }


class Publisher:
    """A publisher of ROS 2; several threads may use it.

    Parameters
    ----------
    session : an open session, with the configuration of :func:`configure`.
    number : unique in the session, from 1.
    ros_type, type_hash : such as ``tf2_msgs/msg/TFMessage``, and its hash ``RIHS01_...``.
    """

    def __init__(
        self,
        session: zenoh.Session,
        node: Entity,
        number: int,
        topic: str,
        ros_type: str,
        type_hash: str,
        qos: Qos,
    ) -> None:
        token = node.publisher_token(number, topic, ros_type, type_hash, qos)
        self._gid, self._sequence, self._lock = gid(token), 0, threading.Lock()
        cached: dict[str, Any] = {}
        if qos.is_latched:
            misses = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S)
            cached = {"cache": ext.CacheConfig(qos.depth), "publisher_detection": True}
            cached["sample_miss_detection"] = misses
        self._publisher = ext.declare_advanced_publisher(
            session,
            topic_key(node.domain, topic, ros_type, type_hash),
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE if qos.is_reliable else zenoh.Reliability.BEST_EFFORT,
            **cached,
        )
        self._token = session.liveliness().declare_token(token)

    def put(self, data: bytes, time_ns: int) -> None:
        """Send a serialised message; ``time_ns`` is the time of sending."""
        with self._lock:
            self._sequence += 1
            self._publisher.put(data, attachment=attachment(self._sequence, time_ns, self._gid))
