"""What went wrong in the user's input, in one line: what, where, and what to do."""

__all__ = ["FitError", "FrameError", "IpsysError", "LogError", "SizeError", "WriteError"]


class IpsysError(Exception):
    """A fault of the input, not of the program.

    The message is one line that says what is wrong, where, and what to do about it; bad rows of a sheet
    follow it, a line each. The command line prints it without a traceback and exits with code 1.
    """


class LogError(IpsysError):
    """A log file cannot be read or written as it is."""


class WriteError(LogError):
    """The disk takes no more, or takes nothing."""


class FitError(IpsysError, ValueError):
    """Data that a model cannot be fitted to; a ValueError too, as scikit-learn's contract wants."""


class FrameError(IpsysError, ValueError):
    """A frame that cannot be decoded."""


class SizeError(IpsysError):
    """A frame of another size than its lens."""
