"""The network of nodes and centre: the address of the centre, and the sessions of Zenoh.

The centre listens, and the nodes connect to it. Sessions search no others (scouting is off), and these
sessions are apart from those of streams to robots. With certificates, both sides prove their names. The
access rules of both sides name the keys of each camera: a node can write only those of its own camera, and
only the centre can ask a node.
"""

from __future__ import annotations

import errno
import ipaddress
import json
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipsys_log.capture.nodes.certificates import CENTRE, Certificates, check_certificates
from ipsys_log.capture.nodes.wire import frames_key, missing_key, state_key
from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigNodes

if TYPE_CHECKING:
    import zenoh

_DEFAULT = "127.0.0.1:7449"
_LARGEST_PORT = 65535
_MOST_SESSIONS = 256
_RETRY = {"period_init_ms": 250, "period_max_ms": 2000, "period_increase_factor": 2}
# A session that hears nothing for this time is closed, and opened again.
_LEASE_MS = 4000


@dataclass(frozen=True, slots=True)
class NodeNetwork:
    """The address of the centre, and the folder of the certificates (None: only on this machine)."""

    host: str
    port: int
    certificates: Path | None = None

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    @property
    def endpoint(self) -> str:
        """The address as Zenoh writes it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'tcp' if self.certificates is None else 'tls'}/{host}:{self.port}"

    def files_of(self, name: str) -> Certificates | None:
        """Return the certificates of a host; None without certificates.

        Raises
        ------
        IpsysError
            A file is missing or not valid.
        """
        if self.certificates is None:
            return None
        files = Certificates.in_folder(self.certificates, name)
        check_certificates(files, name)
        return files


def read_network(
    nodes: RigNodes | None, folder: Path, centre: str | None = None, certificates: Path | None = None
) -> NodeNetwork:
    """Return the network of a rig.

    Parameters
    ----------
    nodes : the table ``[nodes]`` of the rig; None: its defaults.
    folder : the folder of the rig file.
    centre, certificates : replace the values of the rig.

    Raises
    ------
    IpsysError
        The address has another form, or it is that of another machine and there are no certificates.

    Examples
    --------
    >>> str(read_network(None, Path()))
    '127.0.0.1:7449'
    """
    where = "--centre" if centre else "[nodes] centre"
    address = centre or (nodes.centre if nodes else None) or _DEFAULT
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) <= _LARGEST_PORT):
        raise IpsysError(f"{where} {address}: is not an address; write HOST:PORT, such as 192.168.1.10:7449")
    named = nodes.certificates if nodes else None
    if certificates is None and named is not None:
        certificates = folder / named
    if certificates is None and not _is_loopback(host):
        setting = "give --certificates FOLDER" if centre else 'write certificates = "FOLDER" into [nodes]'
        raise IpsysError(
            f"{where} {address}: is another machine, so nodes and centre need certificates; {setting}; "
            "docs/nodes.md shows how to make them"
        )
    return NodeNetwork(host, int(port), certificates)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_centre_session(network: NodeNetwork, cameras: Sequence[str]) -> zenoh.Session:
    """Open the session of the centre, which listens for the nodes of cameras.

    Raises
    ------
    IpsysError
        The port is in use, the host is not this machine, or a certificate is missing or not valid.
    """
    import zenoh

    files = network.files_of(CENTRE)
    _check_free(network)
    settings = {"listen/endpoints": [network.endpoint], "connect/endpoints": []}
    rules, policies, subjects = [], [], []
    for camera in cameras:
        rules += _rules(camera, "ingress", "egress")
        subjects.append({"id": camera} | ({} if files is None else {"cert_common_names": [camera]}))
        policies.append({"rules": [f"data_{camera}", f"ask_{camera}"], "subjects": [camera]})
    return _open(zenoh, settings, files, rules, subjects, policies, network)


def open_node_session(network: NodeNetwork, camera: str) -> zenoh.Session:
    """Open the session of the node of a camera; it connects to the centre as soon as the centre answers.

    Raises
    ------
    IpsysError
        A certificate is missing or not valid.
    """
    import zenoh

    files = network.files_of(camera)
    settings = {
        "listen/endpoints": [],
        "connect/endpoints": [network.endpoint],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
    }
    subjects = [{"id": CENTRE} | ({} if files is None else {"cert_common_names": [CENTRE]})]
    policies = [{"rules": [f"data_{camera}", f"ask_{camera}"], "subjects": [CENTRE]}]
    return _open(zenoh, settings, files, _rules(camera, "egress", "ingress"), subjects, policies, network)


def _rules(camera: str, data_flow: str, ask_flow: str) -> list[dict[str, Any]]:
    """Return the rules of a camera: its node sends and answers, and the centre asks."""
    keys = [frames_key(camera), state_key(camera), missing_key(camera)]
    common = {"permission": "allow", "key_exprs": keys}
    return [
        {
            "id": f"data_{camera}",
            "flows": [data_flow],
            "messages": ["put", "reply", "declare_queryable"],
            **common,
        },
        {"id": f"ask_{camera}", "flows": [ask_flow], "messages": ["query", "declare_subscriber"], **common},
    ]


def _open(
    library: Any,
    settings: dict[str, Any],
    files: Certificates | None,
    rules: list[dict[str, Any]],
    subjects: list[dict[str, Any]],
    policies: list[dict[str, Any]],
    network: NodeNetwork,
) -> zenoh.Session:
    settings = {
        **settings,
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "adminspace/enabled": False,
        "timestamping/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_sessions": _MOST_SESSIONS,
        "transport/link/tx/lease": _LEASE_MS,
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        },
    }
    if files is not None:
        settings["transport/link/tls"] = _tls(files)
    config = library.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        session: Any = library.open(config)
    except library.ZError as error:
        raise IpsysError(f"[nodes] centre {network}: the connection cannot be opened ({error})") from error
    return session  # type: ignore[no-any-return]


def _tls(files: Certificates) -> dict[str, Any]:
    authority, certificate, key = (str(file.resolve()) for file in files)
    return {
        "root_ca_certificate": authority,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "listen_private_key": key,
        "listen_certificate": certificate,
        "connect_private_key": key,
        "connect_certificate": certificate,
    }


def _check_free(network: NodeNetwork) -> None:
    """Check that this machine can listen on the address: the errors of Zenoh name no reason."""
    family = socket.AF_INET6 if ":" in network.host else socket.AF_INET
    try:
        socket.create_server((network.host, network.port), family=family).close()
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            text = f"port {network.port} is in use, perhaps by another ipsys; end that program, or change it"
        elif error.errno == errno.EACCES:
            text = f"port {network.port} is not allowed; give one from 1024 to {_LARGEST_PORT}"
        else:
            text = "is not an address of this machine; the centre needs one of its own addresses"
        raise IpsysError(f"[nodes] centre {network}: {text}") from error
