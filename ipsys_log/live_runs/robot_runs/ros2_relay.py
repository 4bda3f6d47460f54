"""The relay of ROS 2: it subscribes to the poses of a robot, and publishes them again on a router of its own.

Zenoh runs over TCP, which loses no message. So the relay is a node between the stream and the robot, and it
loses whole messages.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from ipsys_log.capture.frames import Clock
from ipsys_log.errors import IpsysError
from ipsys_log.sinks.streams.addresses import LOOPBACK
from ipsys_log.sinks.streams.rmw_zenoh import Entity, Publisher, Qos, configure, topic_key
from ipsys_log.sinks.streams.ros2_messages import POSE, type_hash

_NODE = "ipsys_relay"
_DOMAIN = 0


@contextmanager
def open_ros2(
    robot: str, source: int, target: int, take: Callable[[bytes], object]
) -> Iterator[Callable[[bytes], None]]:
    """Call ``take`` with each serialised pose of a robot; yield a function that publishes such poses.

    Parameters
    ----------
    source : port of the router on this machine that sends the poses.
    target : port of the new router on this machine.

    Raises
    ------
    IpsysError
        The source has no poses of this robot.
    """
    topic = f"/{robot}/pose"
    incoming = _open_client(source)
    outgoing = zenoh.open(configure(_DOMAIN, target))
    try:
        key = topic_key(_DOMAIN, topic, POSE, type_hash(POSE))
        subscriber = incoming.declare_subscriber(key, lambda sample: take(sample.payload.to_bytes()))
        # The router answers after it has read the subscription: from now on, no pose is missed.
        token: Any = f"@ros2_lv/{_DOMAIN}/*/*/*/MP/*/*/*/{topic.replace('/', '%')}/**"
        if not list(incoming.liveliness().get(token)):
            raise IpsysError(f"ROS 2, port {source}: nobody publishes {topic}")
        entity = Entity(_DOMAIN, str(outgoing.info.zid()), _NODE)
        publisher, clock = Publisher(outgoing, entity, 1, topic, POSE, type_hash(POSE), Qos()), Clock()
        yield lambda data: publisher.put(data, clock.now_ns())
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    finally:
        for session in (incoming, outgoing):
            session.close()  # type: ignore[no-untyped-call]


def _open_client(port: int) -> zenoh.Session:
    """Open a client of a router on this machine; it listens nowhere."""
    config = zenoh.Config()
    settings: dict[str, Any] = {"mode": "client", "connect/endpoints": [f"tcp/{LOOPBACK}:{port}"]}
    settings |= {"scouting/multicast/enabled": False, "scouting/gossip/enabled": False}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
