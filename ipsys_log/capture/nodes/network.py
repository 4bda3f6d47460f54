"""The network of nodes and centre: the address of the centre, certificates, and the sessions of Zenoh.

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
import ssl
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ipsys_log.capture.nodes.wire import frames_key, missing_key, state_key
from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigNodes

if TYPE_CHECKING:
    import zenoh


# The name of the centre in its certificate; the name of a node is that of its camera.
CENTRE = "centre"
# The file with the certificate of the authority, the same one on all hosts.
AUTHORITY = "authority.pem"
_CONNECT_S, _REFUSAL_S = 3.0, 0.3
# The codes of OpenSSL for a certificate that another authority has signed.
_OTHER_AUTHORITY = (7, 18, 19, 20, 21)
_GUIDE = "docs/nodes.md shows how to make it"


class Certificates(NamedTuple):
    """The files of one host: the certificate of the lab's authority, the host's own, and its private key."""

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def in_folder(cls, folder: Path, name: str) -> Certificates:
        """Return the files of a host in a folder.

        Examples
        --------
        >>> Certificates.in_folder(Path("certificates"), "red").key.as_posix()
        'certificates/red.key'
        """
        return cls(folder / AUTHORITY, folder / f"{name}.pem", folder / f"{name}.key")


def check_certificates(files: Certificates, name: str) -> None:
    """Check the files of a host by a handshake of the host with itself, without a network.

    Raises
    ------
    IpsysError
        A file is missing or not valid, the authority has not signed the certificate, or it has another name.
    """
    for file in files:
        if not file.is_file():
            raise IpsysError(f"{file}: does not exist; {_GUIDE}")
    try:
        subject = _own_subject(files)
    except ssl.SSLCertVerificationError as error:
        raise IpsysError(
            f"{files.certificate}: is not accepted by {files.authority.name} ({error.verify_message}); "
            f"{_GUIDE}"
        ) from error
    except ssl.SSLError as error:
        raise IpsysError(
            f"{files.certificate}: does not fit {files.key.name}, or a file is damaged ({_reason(error)}); "
            f"{_GUIDE}"
        ) from error
    except OSError as error:
        raise IpsysError(f"{files.key}: cannot be read: {error.strerror}") from error
    if subject != name:
        raise IpsysError(f"{files.certificate}: is the certificate of {subject!r}, not of {name!r}; {_GUIDE}")


def _own_subject(files: Certificates) -> str:
    """Return the common name in a certificate, after a handshake in which both sides use it."""
    contexts = [_context(files, side) for side in (ssl.PROTOCOL_TLS_CLIENT, ssl.PROTOCOL_TLS_SERVER)]
    one, two = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = contexts[0].wrap_bio(one, two, server_side=False)
    server = contexts[1].wrap_bio(two, one, server_side=True)
    waiting = [client, server]
    while waiting:
        for side in tuple(waiting):
            try:
                side.do_handshake()
                waiting.remove(side)
            except ssl.SSLWantReadError:
                continue
    certificate: Any = client.getpeercert() or {}
    names = dict(pair for row in certificate.get("subject", ()) for pair in row)
    return str(names.get("commonName", ""))


def _context(files: Certificates, protocol: int) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.check_hostname, context.verify_mode = False, ssl.CERT_REQUIRED
    try:
        context.load_verify_locations(files.authority)
    except ssl.SSLError as error:
        raise IpsysError(f"{files.authority}: is not a certificate in PEM form; {_GUIDE}") from error
    # Without a password, an encrypted key would ask for one in the terminal.
    context.load_cert_chain(files.certificate, files.key, password=lambda: b"")
    return context


def check_centre(host: str, port: int, files: Certificates) -> str | None:
    """Connect to the centre once; return None if it answers, else the reason why it does not.

    The errors of Zenoh name no reason, so this connection comes before those of Zenoh.

    Raises
    ------
    IpsysError
        The centre answers, but its certificate or that of this host is not accepted.
    """
    context = _context(files, ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = True
    try:
        with socket.create_connection((host, port), _CONNECT_S) as plain:
            _shake_hands(context, plain, host)
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _OTHER_AUTHORITY:
            names = ", ".join(file.name for file in files)
            raise IpsysError(
                f"centre {host}:{port}: its certificate is not of the authority in {files.authority}; copy "
                f"{names} of the centre's authority to this host"
            ) from error
        raise IpsysError(
            f"centre {host}:{port}: its certificate is not accepted with {files.authority} "
            f"({error.verify_message}); {_GUIDE}"
        ) from error
    except ssl.SSLEOFError:
        return "ended the connection"
    except ssl.SSLError as error:
        raise IpsysError(
            f"centre {host}:{port}: does not accept {files.certificate} ({_reason(error)}); {_GUIDE}"
        ) from error
    except TimeoutError:
        return "timed out"
    except UnicodeError:
        return "is no name of a host"
    except OSError as error:
        return (error.strerror or str(error)).lower()
    return None


def _shake_hands(context: ssl.SSLContext, plain: socket.socket, host: str) -> None:
    """Connect with certificates; the centre refuses that of this host only after its own handshake."""
    with context.wrap_socket(plain, server_hostname=host) as secure:
        secure.settimeout(_REFUSAL_S)
        with suppress(TimeoutError):
            secure.recv(1)


def _reason(error: ssl.SSLError) -> str:
    # Without a reason, the text of OpenSSL names only its own library and source line.
    return error.reason.lower().replace("_", " ") if error.reason else "not in PEM form"


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
        """Return the certificates of a host; None without certificates."""
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
    files = network.files_of(CENTRE)
    _check_free(network)
    settings = {"listen/endpoints": [network.endpoint], "connect/endpoints": []}
    rules, policies, subjects = [], [], []
    for camera in cameras:
        rules += _rules(camera, "ingress", "egress")
        subjects.append({"id": camera} | ({} if files is None else {"cert_common_names": [camera]}))
        policies.append({"rules": [f"data_{camera}", f"ask_{camera}"], "subjects": [camera]})
    return _open(settings, files, rules, subjects, policies, network)


def open_node_session(network: NodeNetwork, camera: str) -> zenoh.Session:
    """Open the session of the node of a camera; it connects to the centre as soon as the centre answers."""
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
    return _open(settings, files, _rules(camera, "egress", "ingress"), subjects, policies, network)


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
    settings: dict[str, Any],
    files: Certificates | None,
    rules: list[dict[str, Any]],
    subjects: list[dict[str, Any]],
    policies: list[dict[str, Any]],
    network: NodeNetwork,
) -> zenoh.Session:
    import zenoh

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
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise IpsysError(f"[nodes] centre {network}: the connection cannot be opened ({error})") from error


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
