"""The command ``ipsys``: parse, open, make one library call, print."""

import errno
import shutil
import sys
import textwrap

_LONGEST_COMPLAINT = 100_000


def main() -> None:
    """Run the command line; an error of the input is one line on stderr and exit code 1."""
    from ipsys_log.app.cli.signals import InterruptError, hold_signals

    hold_signals()
    from ipsys_log.app.cli.app import app
    from ipsys_log.app.cli.console import OLD_JSON, print_warnings
    from ipsys_log.errors import IpsysError, is_full, os_error_text

    try:
        with print_warnings():
            app(["--json" if word == OLD_JSON else word for word in sys.argv[1:]])
    except IpsysError as error:
        sys.exit(_complain(str(error)))
    except BrokenPipeError:
        sys.stderr.close()  # the reader of the pipe, such as head, has ended
        sys.exit(0)
    except OSError as error:
        if error.filename is None and not is_full(error) and error.errno != errno.EIO:
            raise
        sys.exit(_complain(os_error_text(error)))
    except InterruptError as interrupt:
        _complain(interrupt.text)
        sys.exit(interrupt.exit_code)


def _complain(text: str) -> int:
    from ipsys_log.plain_text import plain_text

    line = "ipsys: " + plain_text(text, keep="\n", longest=_LONGEST_COMPLAINT)
    if sys.stderr.isatty():  # a file or a pipe gets one line
        width = shutil.get_terminal_size().columns
        line = "\n".join(_wrapped(text_line, width) for text_line in line.splitlines())
    print(line, file=sys.stderr)  # noqa: T201
    return 1


def _wrapped(line: str, width: int) -> str:
    """Return a line that is wrapped between words; further lines have the same indent."""
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.fill(
        line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
