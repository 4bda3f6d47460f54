"""A process of this package with a pipe in both directions.

The process has a session of its own: the keys of the terminal and a closed terminal concern its parent only.
It ends with its pipe, whatever it does, so that none remains after its parent.
"""

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from threading import Thread

# The environment of a process with one BLAS thread. Such a process has no need to load the BLAS of scipy to
# limit its threads, which takes 0.1 s.
ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "OMP_NUM_THREADS"), "1"
)
# The path of modules is that of the parent: the folder of the user has no part in it.
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from ipsys_log.engine.piped_process import end_with_parent; end_with_parent(); "
    "from {module} import {function}; {function}()"
)


class PipedProcess:
    """A process that runs a function, and the pipe to it.

    Parameters
    ----------
    function : a function of a module. It begins with :func:`parent_pipe`.

    Attributes
    ----------
    sender, receiver : the ends of the pipe.

    Raises
    ------
    OSError
        The system has no more processes or file descriptors for this program.
    """

    def __init__(self, function: Callable[[], None]) -> None:
        start = _START.format(module=function.__module__, function=function.__name__)
        modules = json.dumps([path for path in sys.path if path])
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", start, modules],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, **ONE_THREAD},
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            self.sender = Connection(os.dup(self.process.stdin.fileno()), readable=False)
            self.receiver = Connection(os.dup(self.process.stdout.fileno()), writable=False)
        except OSError:  # no file descriptor is free
            self.process.kill()
            self.process.wait()
            raise
        self.process.stdin.close()
        self.process.stdout.close()

    def describe_end(self) -> str:
        """Wait for the end of the process, and return how it ended.

        Examples
        --------
        ``by signal 9``, ``with exit code 1``
        """
        code = self.process.wait()
        return f"by signal {-code}" if code < 0 else f"with exit code {code}"

    def close(self) -> None:
        """Close the pipe; the process then ends."""
        self.sender.close()
        self.receiver.close()

    def stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        self.close()


def end_with_parent() -> None:
    """End this process when its parent closes the pipe or ends; imports may take longer than that."""
    Thread(target=_wait_for_parent, name="ends with the parent", daemon=True).start()


def _wait_for_parent() -> None:
    pipe = select.poll()
    pipe.register(0, 0)  # no event but the end of the pipe, which is always reported
    pipe.poll()
    os._exit(0)


def parent_pipe() -> tuple[Connection, Connection]:
    """Return the ends of the pipe in the started process: that from the parent, and that to the parent."""
    receiver, sender = Connection(os.dup(0), writable=False), Connection(os.dup(1), readable=False)
    os.dup2(2, 1)  # a print of another package must not come between the messages
    return receiver, sender
