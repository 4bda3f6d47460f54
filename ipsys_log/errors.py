"""Errors in the user's input, in one line: what is wrong, where, and what to do.

Any function may raise one. Its docstring names the causes that its first line does not imply.
"""

import errno


class IpsysError(Exception):
    """A fault of the input, not of the program.

    The message is one line that says what is wrong, where, and what to do about it; bad rows of a sheet
    follow it, a line each. The command line prints it without a traceback and exits with code 1.
    """


class LogError(IpsysError):
    """A log file that cannot be read or written."""


class UnreadError(LogError):
    """A log whose bytes cannot be read now: its content is unknown, and not known to be damaged."""


class WriteError(LogError):
    """A disk that is full or cannot be written to. ``cause`` is the error of the operating system."""

    def __init__(self, text: str, cause: OSError) -> None:
        super().__init__(text)
        self.cause = cause


class FitError(IpsysError, ValueError):
    """Data that a model cannot be fitted to; a ValueError too, as scikit-learn's contract wants."""


class FrameError(IpsysError, ValueError):
    """A frame that cannot be decoded."""


class SizeError(IpsysError):
    """A frame of another size than its lens."""


def os_error_text(error: OSError) -> str:
    """Return an error of the operating system in one line, with the name of its file."""
    cause = str(error.strerror or error)
    if is_full(error):
        cause = f"the disk is full; {disk_advice(error)}"
    elif error.errno == errno.EIO:
        cause = f"cannot be read or written ({cause}); {disk_advice(error)}"
    return f"{error.filename}: {cause}" if error.filename else cause


def reason_without(path: object, error: Exception) -> str:
    """Return the text of an error without the path of its log, for a text that names the log itself.

    Examples
    --------
    >>> reason_without("a.mcap", IpsysError("a.mcap: has no rig"))
    'has no rig'
    """
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")


def is_full(error: OSError) -> bool:
    """Return whether a disk, or the quota of the user, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def disk_advice(error: OSError) -> str:
    """Return advice on a disk that cannot be written to, by the error of the operating system."""
    if is_full(error):
        return "free some space and try again"
    if error.errno == errno.EROFS:
        return "the disk is read-only (perhaps after a fault): mount it for writing, or use another disk"
    if error.errno == errno.EFBIG:
        return "the file system does not allow files of this size: use a disk with another file system"
    if error.errno in (errno.EACCES, errno.EPERM):
        return "ask for write permission there, or use another folder"
    return "the disk or its connection has failed: copy the log to another disk, and try again there"
