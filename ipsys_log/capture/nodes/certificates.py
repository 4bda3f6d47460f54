"""Certificates of nodes and centre: their files, and checks before any connection."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path
from typing import NamedTuple

from ipsys_log.errors import IpsysError

__all__ = ["CENTRE", "Certificates", "check_certificates", "refuse_centre"]

# The name of the centre in its certificate; the name of a node is that of its camera.
CENTRE = "centre"
_CONNECT_S = 3.0
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
        return cls(folder / "authority.pem", folder / f"{name}.pem", folder / f"{name}.key")


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
            f"{files.certificate}: is not accepted by {files.authority.name} ({error.verify_message}); {_GUIDE}"
        ) from error
    except ssl.SSLError as error:
        raise IpsysError(
            f"{files.certificate}: does not fit {files.key.name}, or a file is damaged ({_reason(error)}); {_GUIDE}"
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
    names = dict(pair for row in (client.getpeercert() or {}).get("subject", ()) for pair in row)  # type: ignore[misc]
    return str(names.get("commonName", ""))


def _context(files: Certificates, protocol: int) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.check_hostname, context.verify_mode = False, ssl.CERT_REQUIRED
    context.load_verify_locations(files.authority)
    # Without a password, an encrypted key would ask for one in the terminal.
    context.load_cert_chain(files.certificate, files.key, password=lambda: b"")
    return context


def refuse_centre(host: str, port: int, files: Certificates) -> str | None:
    """Connect to the centre once; return None if it answers with a valid certificate, else the reason.

    Raises
    ------
    IpsysError
        The centre answers, but its certificate or that of this host is not accepted.
    """
    context = _context(files, ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = True
    try:
        with (
            socket.create_connection((host, port), _CONNECT_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as secure,
        ):
            secure.settimeout(_CONNECT_S / 10)
            # The centre refuses the certificate of this host only after its own handshake.
            secure.recv(1)
    except TimeoutError as error:
        return None if "handshake" not in str(error) and "timed out" in str(error) else str(error)
    except ssl.SSLCertVerificationError as error:
        raise IpsysError(
            f"centre {host}:{port}: its certificate is not accepted by {files.authority} "
            f"({error.verify_message}); {_GUIDE}"
        ) from error
    except ssl.SSLError as error:
        raise IpsysError(
            f"centre {host}:{port}: does not accept {files.certificate} ({_reason(error)}); {_GUIDE}"
        ) from error
    except OSError as error:
        return error.strerror or str(error)
    return None


def _reason(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).lower().replace("_", " ")
