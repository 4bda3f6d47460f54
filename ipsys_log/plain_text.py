"""Text that is safe to print: without control characters, without passwords, and names in one line."""

import re
import shlex
import unicodedata
from collections.abc import Sequence

# Control characters, invisible ones that change the direction of text, bytes of a file name that are not
# UTF-8, and separators of lines.
_UNSAFE = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
_LONGEST = 2_000
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


def plain_text(text: str, *, keep: str = "", longest: int = _LONGEST) -> str:
    r"""Return `text` with control characters as escapes, cut to `longest` characters.

    Names in a log are untrusted. A terminal executes an escape sequence in a name; it can hide text, or
    change other text.

    Parameters
    ----------
    text : any text, such as the name of a run, a topic or a file.
    keep : control characters that stay, such as the ends of lines.
    longest : the most characters that are returned, before escapes.

    Examples
    --------
    >>> plain_text("red\x1b[31m\u202e lab")
    'red\\x1b[31m\\u202e lab'
    """
    if len(text) > longest:
        text = f"{text[:longest]} ... ({len(text)} characters)"
    if text.isprintable():
        return text
    return "".join(sign if sign in keep or _is_safe(sign) else _escape(sign) for sign in text)


def _is_safe(sign: str) -> bool:
    return unicodedata.category(sign) not in _UNSAFE


def _escape(sign: str) -> str:
    number = ord(sign)
    if number < 0x100:
        return f"\\x{number:02x}"
    return f"\\u{number:04x}" if number < 0x10000 else f"\\U{number:08x}"


def shell_words(*names: object) -> str:
    """Return names of files as words of a suggested command: a shell reads each of them as one word.

    Examples
    --------
    >>> print("ipsys info", shell_words("a b.mcap", "c.mcap"))
    ipsys info 'a b.mcap' c.mcap
    """
    return " ".join(shlex.quote(str(name)) for name in names)


def join_names(names: Sequence[str], most: int = 5) -> str:
    """Return names with commas; of many names, the first ones and the number of the others.

    Examples
    --------
    >>> join_names(["red", "white"]), join_names(["a1", "a2", "a3", "a4"], most=3)
    ('red, white', 'a1, a2, a3 and 1 more')
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


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
