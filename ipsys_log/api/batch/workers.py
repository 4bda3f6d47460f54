"""Workers of a batch: processes on this machine, or those of an existing Dask scheduler."""

from __future__ import annotations

import importlib.metadata
import logging
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipsys_log import __version__
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation

if TYPE_CHECKING:
    from distributed import Client, Security

_LOOPBACK = "127.0.0.1"
_CONNECT_TIMEOUT_S = 15.0
_DISTRIBUTION = "ipsys_log"
# A piece of a log has about this many bytes or more, so a smaller log is one task.
_PIECE_BYTES = 4 << 20
_MOST_PIECES = 1024  # of a log of unknown size
# An existing cluster can grow, and it grows only if tasks wait.
_LEAST_WAITING = 8
# With less, Dask ends each worker process before its first task, and starts it again without end.
_LEAST_MEMORY_BYTES = 256 * 10**6
# Dask's settings of the workers on this machine.
_CONFIG: Mapping[str, Any] = {
    # The batch itself counts how often a log has ended its worker.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.worker-saturation": 1.0,
    # A task needs its memory until it ends: a paused worker would wait forever. Above the limit, it ends.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.worker.preload": [__name__],  # calls dask_setup()
}
_ENCRYPTED = "tls://"


@dataclass(slots=True)
class Workers:
    """Connected workers.

    Attributes
    ----------
    client : the connection to their scheduler.
    address : of the scheduler.
    dashboard : address of the page that shows the work.
    local : the number of worker processes on this machine; 0 with an existing scheduler.
    is_stopped : True if the batch ends, perhaps before its logs are done.
    """

    client: Client
    address: str
    dashboard: str
    local: int = 0
    is_stopped: bool = False

    def window(self) -> int:
        """Return the number of tasks to submit at once: it does not depend on the number of logs.

        On this machine, each worker has one task, so that the end of a worker affects one log.
        """
        return self.local or max(_LEAST_WAITING, 2 * sum(self.client.nthreads().values()))

    def check_connection(self) -> None:
        """Check that the batch goes on."""
        if self.is_stopped or self.client.status in ("closing", "closed"):
            raise IpsysError(
                f"the scheduler {self.address} was lost; results so far are in the logs; to continue, repeat "
                "the command"
            )


def most_tasks(logs: Iterable[LogLocation]) -> int:
    """Return the number of tasks that may run at the same time: long logs have pieces."""
    sizes = (log.stat().st_size if isinstance(log, Path) and log.is_file() else None for log in logs)
    # The size of a log at a URL would be a request.
    return sum(_MOST_PIECES if size is None else 1 + size // _PIECE_BYTES for size in sizes)


@contextmanager
def open_workers(settings: WorkerSettings, tasks: int) -> Iterator[Workers]:
    """Start worker processes on this machine, or connect to an existing scheduler.

    Parameters
    ----------
    tasks : the number of tasks at the same time: more worker processes would have no work.

    Raises
    ------
    IpsysError
        The settings do not fit, the scheduler cannot be reached, or a worker has another version.
    """
    settings.check()
    with ExitStack() as stack:
        if settings.scheduler is None:
            workers = stack.enter_context(_local_workers(settings, tasks))
        else:
            workers = stack.enter_context(_connected_workers(settings.scheduler, settings))
        _check_versions(workers.client)
        yield workers


@contextmanager
def _local_workers(settings: WorkerSettings, tasks: int) -> Iterator[Workers]:
    import dask
    from dask.system import CPU_COUNT
    from distributed import Client, LocalCluster, Security

    count = min(settings.workers or CPU_COUNT, max(tasks, 1))
    limit = _parse_limit(settings.memory_limit)
    with (
        dask.config.set(_CONFIG),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host=_LOOPBACK,
            dashboard_address=f"{_LOOPBACK}:0",
            # On loopback, too: other users of this machine could run code as this user.
            security=Security.temporary(),
            silence_logs=logging.CRITICAL,
            **({} if limit is None else {"memory_limit": limit}),
        ) as cluster,
        Client(cluster) as client,
    ):
        yield Workers(client, cluster.scheduler_address, client.dashboard_link, count)


def dask_setup(_worker: object) -> None:
    """Prepare a worker process of this machine: Ctrl-C is for the driver, which ends the workers."""
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)  # each core has a process


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """The settings of the workers.

    Attributes
    ----------
    scheduler : the address of an existing scheduler; None: worker processes on this machine.
    workers : number of worker processes on this machine; None: one for each core.
    memory_limit : of each worker process on this machine, such as ``2GB``; None: an equal share.
    tls_ca, tls_cert, tls_key : certificates for the scheduler; None: those of Dask's configuration.
    insecure : permit a scheduler without certificates.
    """

    scheduler: str | None = None
    workers: int | None = None
    memory_limit: str | None = None
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    insecure: bool = False

    def check(self) -> None:
        """Check that the settings fit together, and that an existing scheduler is protected."""
        files = {"--tls-ca": self.tls_ca, "--tls-cert": self.tls_cert, "--tls-key": self.tls_key}
        if self.scheduler is None:
            unused = [name for name, file in files.items() if file] + ["--insecure"] * self.insecure
            if unused:
                raise IpsysError(f"{unused[0]}: has an effect only with --scheduler; leave it out")
            return
        for name, value in (("--workers", self.workers), ("--memory-limit", self.memory_limit)):
            if value is not None:
                raise IpsysError(f"{name}: the scheduler has its own workers; leave out {name}")
        for name, file in files.items():
            if file is not None and not file.is_file():
                raise IpsysError(
                    f"{name} {file}: is not a file; name the certificate or key for the scheduler"
                )
        if not self.scheduler.startswith(_ENCRYPTED) and not self.insecure:
            raise IpsysError(
                f"--scheduler {self.scheduler}: is not encrypted, and each program that reaches a scheduler "
                "can run code on its workers; use tls:// with certificates, or give --insecure in a network "
                "that you trust"
            )


def _parse_limit(text: str | None) -> int | None:
    from dask.utils import parse_bytes

    if text is None:
        return None
    try:
        size = int(parse_bytes(text))
    except ValueError:
        size = 0
    if size <= 0:
        raise IpsysError(f"--memory-limit {text}: is not a size; write a number with its unit, such as 2GB")
    if size < _LEAST_MEMORY_BYTES:
        raise IpsysError(
            f"--memory-limit {text}: a worker needs {_LEAST_MEMORY_BYTES // 10**6} MB or more without a log; "
            "give more, such as 2GB"
        )
    return size


@contextmanager
def _connected_workers(address: str, settings: WorkerSettings) -> Iterator[Workers]:
    from distributed import Client

    _silence()
    try:
        client = Client(address, security=_security(address, settings), timeout=_CONNECT_TIMEOUT_S)
    except (OSError, ValueError, TypeError) as error:
        cause = str(error).partition("\n")[0]
        raise IpsysError(
            f"--scheduler {address}: cannot be reached; start the scheduler, or check the address and the "
            f"certificates ({cause})"
        ) from None
    with client:
        yield Workers(client, address, client.dashboard_link)


def _silence() -> None:
    """Switch off Dask's log messages on the terminal: the batch reports each failure itself."""
    for name in ("distributed", "distributed.client", "distributed.comm", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _security(address: str, settings: WorkerSettings) -> Security | None:
    from distributed import Security

    if not address.startswith("tls://"):
        return None
    files = {
        "tls_ca_file": settings.tls_ca,
        "tls_client_cert": settings.tls_cert,
        "tls_client_key": settings.tls_key,
    }
    given = {name: str(file) for name, file in files.items() if file is not None}
    security = Security(require_encryption=True, **given)
    if any(getattr(security, name) is None for name in files):
        raise IpsysError(
            f"--scheduler {address}: needs certificates; give --tls-ca, --tls-cert and --tls-key, or set "
            "them in Dask's configuration (distributed.comm.tls)"
        )
    return security


def _check_versions(client: Client) -> None:
    """Check that all workers have this version of ipsys. Each task checks the worker that does it, too."""
    ask: Callable[[str], str] = importlib.metadata.version
    versions = client.run(ask, _DISTRIBUTION, on_error="return")
    for worker, version in sorted(versions.items()):
        if version != __version__:
            found = f"ipsys {version}" if isinstance(version, str) else "no ipsys"
            raise IpsysError(
                f"worker {worker} has {found}, but this is ipsys {__version__}; install one version "
                "everywhere"
            )
