"""Nodes of several cameras in one process, which send recorded markers in real time.

    python benchmarks/node_players.py markers.mcap 127.0.0.1:7449 a1,a2,a3

The process prints ``asked`` when the centre has asked all nodes. Then it reads a start time in ns of UTC, and
sends each message of markers at its time after this start, with the lowest priority. At the end, it prints
``played``, and waits until the centre has all frames. Then it prints the number of frames of each camera, and
of frames that it still has.
"""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event

sys.path.append(str(Path(__file__).resolve().parent.parent))

from ipsys_log import __version__
from ipsys_log.capture.frames import Clock
from ipsys_log.capture.nodes.network import NodeNetwork
from ipsys_log.capture.nodes.node import Node
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message
from ipsys_log.messages.channels import MARKERS
from ipsys_log.units import NS_PER_S
from tests.geometric.session import MARKERS_RUN

__all__ = ["play"]


def play(log: Path, network: NodeNetwork, cameras: list[str]) -> None:
    """Send the markers of some cameras in a log, one node for each camera.

    The nodes have no logs: they send again from their memory.
    """
    clock, asked = Clock(), {camera: Event() for camera in cameras}
    with Session([log]) as session:
        topics = [MARKERS.topic_of(MARKERS_RUN, camera) for camera in cameras]
        messages = list(session.messages(topics))
    with ExitStack() as stack:
        nodes = {
            camera: stack.enter_context(
                Node(
                    camera,
                    network,
                    __version__,
                    log,
                    clock,
                    partial(_note_centre, flag),
                    sends_markers=True,
                )
            )
            for camera, flag in asked.items()
        }
        for flag in asked.values():
            flag.wait()
        print("asked", flush=True)
        sent = _send(messages, nodes, clock, int(sys.stdin.readline()) - EPOCH_NS)
        print("played", flush=True)
        left = sum(node.finish(has_ended=True) for node in nodes.values())
    print(json.dumps({"sent": sent, "left": left}), flush=True)


def _note_centre(asked: Event, text: str) -> None:
    if text.startswith("the centre"):
        asked.set()


def _send(messages: list[Message], nodes: dict[str, Node], clock: Clock, later_ns: int) -> dict[str, int]:
    """Hand each message to its node at its time; return the number of messages by camera."""
    sent = dict.fromkeys(nodes, 0)
    for message in messages:
        wait_ns = message.log_time_ns + later_ns - clock.now_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / NS_PER_S)
        camera, stamp_ns = str(message.camera), message.publish_time_ns + later_ns
        payload = replace(message.payload, timestamp=stamp_ns)
        nodes[camera](replace(message, publish_time_ns=stamp_ns, payload=payload))
        sent[camera] += 1
    return sent


if __name__ == "__main__":
    os.nice(19)
    host, _, port = sys.argv[2].rpartition(":")
    play(Path(sys.argv[1]), NodeNetwork(host, int(port)), sys.argv[3].split(","))
