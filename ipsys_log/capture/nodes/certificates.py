"""Certificates of nodes and centre: their files, and checks before any connection."""

from __future__ import annotations

import socket
import ssl
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from ipsys_log.errors import IpsysError

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
