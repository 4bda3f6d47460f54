"""A node and a centre on separate hosts, with certificates, behind a network with delays and faults."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.log.dataset import Session
from ipsys_log.log.growing_channel import GrowingChannel
from ipsys_log.messages import ClockEstimate, CompressedImage, clock_topic, image_topic
from ipsys_log.tools.soundness.check import check_logs
from ipsys_log.units import NS_PER_S
from tests.capture.nodes.lab_of_nodes import make_certificates
from tests.capture.nodes.namespaces import CENTRE_IP, RELAY_IP, Hosts, in_host, three_hosts
from tests.capture.nodes.tcp_relay import DELAYS_S
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S, wait_until

PORT = 7449
MS = NS_PER_S // 1000
# The clock of the node is ahead by this time.
AHEAD_NS = 86_400 * NS_PER_S + 123_456_789
RIG = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2

[nodes]
centre = "{host}:7449"
certificates = "lab/certificates"

[[cameras]]
name = "red"
source = "{source}"
width = 480
height = 270
rate_hz = 10
"""


@contextmanager
def started(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Start a program; it is killed if the test fails."""
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as program:
        try:
            yield program
        finally:
            program.kill()


def module(host: str, name: str, *arguments: object) -> list[str]:
    return in_host(host, sys.executable, "-m", f"tests.capture.nodes.{name}", *map(str, arguments))


def read_new(channel: GrowingChannel, read: list[Any]) -> list[Any]:
    """Append the new messages of a log to a list, and return the list."""
    while (payload := channel.read(len(read))) is not None:
        read.append(payload)
    return read


def is_sharp(estimate: ClockEstimate) -> bool:
    """Return whether the bound shows the asymmetry: it is at most 10 ms more than half of both delays."""
    return estimate.bound_ns <= sum(DELAYS_S) / 2 * NS_PER_S + 10 * MS


def record_on_hosts(hosts: Hosts, folder: Path) -> None:
    """Record at a node and at the centre until the faults have passed and all frames have arrived."""
    make_certificates(folder / "lab", RELAY_IP, "red")
    for name, host, source in (("node", RELAY_IP, "usb:/dev/null"), ("centre", CENTRE_IP, "zenoh:red")):
        (folder / f"{name}.toml").write_text(RIG.format(host=host, source=source))
    anchor_ns = time.time_ns() - time.monotonic_ns()
    with ExitStack() as stack:
        relay = stack.enter_context(
            started(*module(hosts.relay, "tcp_relay", RELAY_IP, PORT, CENTRE_IP, 1, 4))
        )
        assert relay.stdout is not None
        assert relay.stdout.readline() == "ready\n"
        node = stack.enter_context(
            started(
                *module(hosts.node, "patient_host", anchor_ns + AHEAD_NS, "node", folder / "node.toml"),
                *("--camera", "red", "-o", str(folder / "red.mcap")),
            )
        )
        centre = stack.enter_context(
            started(
                *module(hosts.centre, "patient_host", anchor_ns, "record", "--rig", folder / "centre.toml"),
                *("-o", str(folder / "centre.mcap")),
            )
        )
        programs = [node, centre]
        wait_until((folder / "centre.mcap").exists, "the centre records", programs=programs)
        for line in relay.stdout:
            if line == "calm\n":
                break
        clocks, estimates = GrowingChannel(folder / "centre.mcap", clock_topic("red")), list[ClockEstimate]()
        wait_until(
            lambda: any(map(is_sharp, read_new(clocks, estimates))),
            "an estimate of the clock is exact",
            lambda: estimates[-1:],
            programs,
        )
        stop(node)
        frames = GrowingChannel(folder / "centre.mcap", image_topic("red")), list[CompressedImage]()
        made = images(folder / "red.mcap")

        def has_all_since_its_first() -> bool:
            arrived = {made.index(payload.data) for payload in read_new(*frames)}
            return arrived == set(range(min(arrived), len(made)))

        wait_until(has_all_since_its_first, "the centre has all frames since its first", programs=[centre])
        stop(centre)


def stop(program: subprocess.Popen[str]) -> None:
    program.terminate()
    said, _ = program.communicate(timeout=PATIENCE_S)
    assert program.returncode == 0, said
    assert "the centre does not have" not in said


def images(log: Path) -> list[bytes]:
    with Session([log]) as session:
        return [payload.data for payload in session.payloads([session.images["red"]])]


@pytest.mark.slow
def test_hosts_with_a_faulty_network_lose_no_frame_and_no_time(tmp_path: Path) -> None:
    """The connection breaks twice, and twice nothing passes; the delays of both directions differ.

    The oracle of the clock is its known offset. Half of the difference of the delays is its error, and the
    stated bound contains it.
    """
    with three_hosts() as hosts:
        record_on_hosts(hosts, tmp_path)
    with Session([tmp_path / "red.mcap"]) as node, Session([tmp_path / "centre.mcap"]) as centre:
        topic = node.images["red"]
        made = [(m.publish_time_ns, m.payload.format, m.payload.data) for m in node.messages([topic])]
        arrived = {m.payload.data: (m.publish_time_ns, m.payload) for m in centre.messages([topic])}
        estimates = centre.payloads([clock_topic("red")])
        kinds = [event.kind for event in centre.payloads(["/events"])]
    (checked,) = check_logs([tmp_path / "centre.mcap"])
    assert not [finding.text for finding in checked.findings if "capture times" in finding.text]
    first = min(index for index, row in enumerate(made) if row[2] in arrived)
    assert len({row[2] for row in made}) == len(made)
    for node_ns, image_format, data in made[first:]:
        centre_ns, payload = arrived.pop(data)
        assert payload.format == image_format
        # The estimates below are the exact test; here, no time is wrong by the offset.
        assert abs(node_ns - AHEAD_NS - centre_ns) < AHEAD_NS / 60
    assert arrived == {}
    assert {"node_gap", "node_gap_filled"} <= set(kinds)
    assert not {"node_restarted", "node_frames_lost", "clock_jumped"} & set(kinds)
    for estimate in estimates:
        assert abs(estimate.offset_ns + AHEAD_NS) <= estimate.bound_ns + 1
    sharp = [estimate for estimate in estimates if is_sharp(estimate)]
    half_ns = (DELAYS_S[0] - DELAYS_S[1]) / 2 * NS_PER_S
    for estimate in sharp:
        assert estimate.offset_ns + AHEAD_NS == pytest.approx(half_ns, abs=10 * MS)
