"""Settings of a batch: its workers, and the protection of their scheduler."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ipsys_log.errors import IpsysError

_ENCRYPTED = "tls://"


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
        """Check that the settings fit together, and that an existing scheduler is protected.

        Raises
        ------
        IpsysError
            An option has no effect, a file is missing, or the scheduler has no certificates.
        """
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
