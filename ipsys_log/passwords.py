"""Passwords in addresses: output and logs show none."""

from __future__ import annotations

import re

# Text that replaces a password in public texts.
HIDDEN = "***"
# A host with a dot and its port, and then a path or query: no user and password.
_PORT = r"(?![^/?@:\[]*\.[^/?@:\[]*:[0-9]+(?:/[^@?]*)?(?:\?|$))"
# A password ends at the last @, because it may contain any character. A name without a password may be a
# token. A password may also be a part of the query.
_PASSWORDS = (
    re.compile(rf"(?<=://){_PORT}(?P<before>[^/?@:\[]*:).*(?=@)"),
    re.compile(r"(?<=://)(?P<before>)[^/?@:\[]+(?=@)"),
    re.compile(r"(?P<before>(?:(?:pas|pw|psw|token|auth|secret)[\w-]*|key)=)[^&]+", re.IGNORECASE),
)


def hide_password(address: str) -> str:
    """Return an address without its password, for messages and logs.

    Examples
    --------
    >>> hide_password("rtsp://admin:secret@10.0.0.7:554/live")
    'rtsp://admin:***@10.0.0.7:554/live'
    >>> hide_password("http://10.0.0.7:80/video?user=admin&pwd=secret")
    'http://10.0.0.7:80/video?user=admin&pwd=***'
    """
    for password in _PASSWORDS:
        address = password.sub(rf"\g<before>{HIDDEN}", address)
    return address
