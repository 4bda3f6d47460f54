"""Frames of nodes over a session of Zenoh: bytes, times, gaps, certificates and refusals."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zenoh

from ipsys_log.capture.frames import Clock, Frame, SourceError, SourceMessage
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.nodes.centre import Centre, _Link
from ipsys_log.capture.nodes.network import NodeNetwork, read_network
from ipsys_log.capture.nodes.wire import FrameHeader, frames_key
from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera, RigNodes
from tests.capture.nodes.lab_of_nodes import Received, ShiftedClock, make_certificates, receiving, sending
from tests.ports import free_port
from tests.waiting import wait_until

HOUR_NS = 3600 * 1_000_000_000


def cameras(*names: str) -> list[RigCamera]:
    return [RigCamera(name, source=f"zenoh:{name}") for name in names or ("red",)]


def first_of(items: Iterator[Frame | SourceMessage | None]) -> Frame | SourceMessage:
    """Return the first item that arrives."""
    for item in items:
        if item is not None:
            return item
        time.sleep(0.001)
    raise AssertionError("the frames have ended")


def local() -> NodeNetwork:
    return NodeNetwork("127.0.0.1", free_port())


@pytest.mark.slow
def test_frames_arrive_unchanged_with_the_times_of_the_centre(tmp_path: Path) -> None:
    """The clock of the node is an hour ahead of that of the centre."""
    network, clock = local(), Clock()
    with (
        sending(tmp_path, network, clock=ShiftedClock(clock, HOUR_NS)) as feed,
        Centre(cameras(), network, "0.1.0") as centre,
    ):
        feed.record(5)  # before the recording of the centre
        with receiving(centre, clock=clock) as received:
            made = feed.record(20)
            received.wait_for_data(made)
            assert sorted(frame.data for frame in received.frames) == sorted(made)
            for estimate in received.estimates:
                assert abs(estimate.offset_ns + HOUR_NS) <= estimate.bound_ns + 1
            for frame in received.frames:
                assert frame.time_ns is not None
                # The bound above is the exact test; here, no time is wrong by the offset.
                assert abs(feed.times_ns[frame.data] - HOUR_NS - frame.time_ns) < HOUR_NS / 60


@pytest.mark.slow
def test_certificates_limit_each_node_to_its_own_camera(tmp_path: Path) -> None:
    folder = make_certificates(tmp_path / "lab", "127.0.0.1", "red", "white")
    network = NodeNetwork("127.0.0.1", free_port(), folder)
    with (
        Centre(cameras("red", "white"), network, "0.1.0") as centre,
        sending(tmp_path, network, "red") as red,
        sending(tmp_path, network, "white") as white,
        receiving(centre, "red") as from_red,
        receiving(centre, "white") as from_white,
    ):
        made_red, made_white = red.record(2), white.record(2)
        from_white.wait_for_data(made_white)
        from_red.wait_for_data(made_red)
        with zenoh.open(foreign_session(network, "white")) as foreign:

            def is_through(now: Received) -> bool:
                for name, session, data in (
                    ("red", red.node.session_name, b"false"),
                    ("white", white.node.session_name, b"own"),
                ):
                    header = FrameHeader(session, 2, white.clock.now_ns(), "jpeg")
                    foreign.put(frames_key(name), data, attachment=header.encode())
                return b"own" in {frame.data for frame in now.frames}

            from_white.wait_until(is_through, "a frame of the foreign session arrives")
            later = red.record(3)
            from_red.wait_for_data(later)
            assert sorted(frame.data for frame in from_red.frames) == sorted(made_red + later)
        # Without a certificate of the lab, no session begins.
        assert refused(network)


def foreign_session(network: NodeNetwork, name: str | None) -> zenoh.Config:
    """Return a configuration without rules of its own, with the certificate of a name, or with none."""
    config = zenoh.Config()
    folder = network.certificates
    tls: dict[str, Any] = {"root_ca_certificate": f"{folder}/authority.pem"}
    if name is not None:
        tls |= {"enable_mtls": True, "connect_private_key": f"{folder}/{name}.key"}
        tls |= {"connect_certificate": f"{folder}/{name}.pem"}
    for key, value in {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [network.endpoint],
        "connect/timeout_ms": 2000 if name is None else 240_000,
        "connect/exit_on_failure": True,
        "scouting/gossip/enabled": False,
        "scouting/multicast/enabled": False,
        "transport/link/tls": tls,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def refused(network: NodeNetwork) -> bool:
    try:
        zenoh.open(foreign_session(network, None)).close()  # type: ignore[no-untyped-call]
    except zenoh.ZError:
        return True
    return False


@pytest.mark.slow
def test_calls_of_zenoh_end_before_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python ends a daemon thread within a call of Zenoh, and the program would abort (exit code 134)."""
    monkeypatch.setattr("ipsys_log.capture.nodes.centre._FIRST_ANSWER_S", 0.5)
    daemons: set[str] = set()
    ask = _Link._ask_state

    def watch(link: _Link) -> None:
        ask(link)
        daemons.update(thread.name for thread in threading.enumerate() if thread.daemon)

    monkeypatch.setattr(_Link, "_ask_state", watch)
    with (
        Centre(cameras(), local(), "0.1.0") as centre,
        pytest.raises(SourceError, match="no node red"),
        LiveCameras(cameras(), centre.open, Clock()),
    ):
        pass
    assert not [name for name in daemons if name == "nodes" or "closure" in name]


@pytest.mark.slow
def test_centre_without_a_node_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.nodes.centre._FIRST_ANSWER_S", 0.5)
    with (
        Centre(cameras(), local(), "0.1.0") as centre,
        pytest.raises(
            SourceError, match=r"no node red answers at 127\.0\.0\.1:\d+; start it on its host: ipsys"
        ),
        centre.open(cameras()[0], Clock(), lambda text: None) as items,
    ):
        first_of(items)


@pytest.mark.slow
def test_foreign_authority_is_named_by_centre_and_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node starts before the centre: neither of them sees the certificate of the other at its start."""
    monkeypatch.setattr("ipsys_log.capture.nodes.centre._FIRST_ANSWER_S", 0.5)
    monkeypatch.setattr("ipsys_log.capture.nodes.node._CHECK_NS", 1)
    own, foreign = (make_certificates(tmp_path / name, "127.0.0.1", "red") for name in ("own", "foreign"))
    network, said = NodeNetwork("127.0.0.1", free_port(), own), list[str]()
    with (
        sending(tmp_path, replace(network, certificates=foreign), say=said.append),
        Centre(cameras(), network, "0.1.0") as centre,
    ):
        with (
            pytest.raises(SourceError, match=r"no node red answers at 127\.0\.0\.1:\d+;") as error,
            centre.open(cameras()[0], Clock(), lambda text: None) as items,
        ):
            first_of(items)
        check = f"check that the authority.pem of its host is the same file as {own}/authority.pem"
        assert f"If it runs there, {check}" in str(error.value)
        refusal = (
            f"centre {network}: its certificate is not of the authority in {foreign}/authority.pem; copy "
            "authority.pem, red.pem, red.key of the centre's authority to this host"
        )
        wait_until(lambda: any(line.startswith(refusal) for line in said), "the node refuses", lambda: said)
        with pytest.raises(IpsysError) as refused_start:
            sending(tmp_path, replace(network, certificates=foreign)).__enter__()
        assert str(refused_start.value) == refusal
        with receiving(centre) as received:
            with sending(tmp_path, network):
                received.wait_until(lambda now: "node_answers" in now.kinds(), "the node answers")
            received.wait_until(lambda now: "does not answer" in str(now.errors), "the node is missed")
        assert f"If it was started again, {check}" in str(received.errors[-1])
    assert sum(line.startswith(refusal) for line in said) == 1


def test_port_in_use_and_foreign_address_are_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(IpsysError, match=rf"\[nodes\] centre 127.0.0.1:{port}: port {port} is in use"):
            Centre(cameras(), NodeNetwork("127.0.0.1", port), "0.1.0")
    text = r"\[nodes\] centre 192\.0\.2\.7:7449: is another machine, so nodes and centre need certificates"
    with pytest.raises(IpsysError, match=text):
        read_network(RigNodes("192.0.2.7:7449"), Path())
    with pytest.raises(IpsysError, match="need certificates; give --certificates FOLDER"):
        read_network(None, Path(), "192.0.2.7:7449")
    with pytest.raises(IpsysError, match="--centre 7449: is not an address; write HOST:PORT"):
        read_network(None, Path(), "7449")
    assert read_network(RigNodes("[::1]:7449"), Path()).endpoint == "tcp/[::1]:7449"
    assert read_network(RigNodes("10.0.0.1:7449", "keys"), Path("lab")).certificates == Path("lab/keys")


def test_wrong_certificates_are_named(tmp_path: Path) -> None:
    folder = make_certificates(tmp_path / "lab", "127.0.0.1", "red")
    other = make_certificates(tmp_path / "other", "127.0.0.1", "red")

    def refusal(name: str) -> str:
        with pytest.raises(IpsysError) as error:
            NodeNetwork("127.0.0.1", 1, folder).files_of(name)
        assert "\n" not in str(error.value)
        return str(error.value).replace(f"{folder}/", "")

    assert NodeNetwork("127.0.0.1", 1, folder).files_of("red") is not None
    assert refusal("white") == "white.pem: does not exist; docs/nodes.md shows how to make it"
    for suffix in ("pem", "key"):
        (folder / f"white.{suffix}").write_bytes((folder / f"red.{suffix}").read_bytes())
    assert "white.pem: is the certificate of 'red', not of 'white'" in refusal("white")
    (folder / "white.key").write_bytes((other / "red.key").read_bytes())
    assert "white.pem: does not fit white.key" in refusal("white")
    (folder / "white.pem").write_bytes((other / "red.pem").read_bytes())
    assert "white.pem: is not accepted by authority.pem" in refusal("white")
    (folder / "white.pem").write_bytes(b"garbage")
    assert "a file is damaged (not in PEM form)" in refusal("white")
    (folder / "authority.pem").write_bytes(b"garbage")
    assert refusal("red").startswith("authority.pem: is not a certificate in PEM form")
