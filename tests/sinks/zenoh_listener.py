"""A session of Zenoh as a node of ROS 2 opens it, and the messages that it receives."""

import json
import threading
from typing import Any

import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh import ext

_LIMIT_S = 240.0
STORE = get_typestore(Stores.LATEST)


def open_node(port: int, mode: str = "peer") -> Any:
    """Open a session as rmw_zenoh_cpp does: a peer without multicast, connected to the router."""
    config = zenoh.Config()
    settings: dict[str, Any] = {"mode": mode, "connect/endpoints": [f"tcp/localhost:{port}"]}
    settings |= {"scouting/multicast/enabled": False, "listen/endpoints": ["tcp/localhost:0"]}
    if mode == "client":
        settings["listen/endpoints"] = []
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class ZenohListener:
    """A subscriber to topics of domain 0. It takes key expressions from the format of rmw_zenoh."""

    def __init__(self, port: int, *topics: str, domain: int = 0) -> None:
        self.session = open_node(port)
        self._changed = threading.Condition()
        self.samples: list[tuple[str, str, Any, bytes]] = []
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        # The type and its hash are two parts of the key.
        self._subscribers = [
            ext.declare_advanced_subscriber(self.session, f"{domain}{topic}/*/*", self._take, history=history)
            for topic in topics
        ]

    def _take(self, sample: Any) -> None:
        _, *topic, dds_type, _ = str(sample.key_expr).split("/")
        package, _, _, name = dds_type.split("::")
        ros_type = f"{package}/msg/{name.removesuffix('_')}"
        message = STORE.deserialize_cdr(sample.payload.to_bytes(), ros_type)
        attached = b"" if sample.attachment is None else sample.attachment.to_bytes()
        with self._changed:
            self.samples.append((f"/{'/'.join(topic)}", str(sample.key_expr), message, attached))
            self._changed.notify_all()

    def messages(self, topic: str, count: int = 1) -> list[Any]:
        """Wait for messages of a topic; return all so far."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self._of(topic)) >= count, _LIMIT_S), self.topics()
            return self._of(topic)

    def topics(self) -> set[str]:
        return {topic for topic, *_ in self.samples}

    def attachments(self, topic: str) -> list[bytes]:
        return [attached for name, _, _, attached in self.samples if name == topic]

    def tokens(self) -> list[str]:
        """Return the liveliness tokens of all nodes and publishers."""
        replies = self.session.liveliness().get("@ros2_lv/0/**")
        return sorted(str(reply.ok.key_expr) for reply in replies)

    def close(self) -> None:
        self.session.close()

    def _of(self, topic: str) -> list[Any]:
        return [message for name, _, message, _ in self.samples if name == topic]
