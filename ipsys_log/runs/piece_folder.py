"""The results of pieces in a folder that all workers see, named by content and attempt.

A piece may be computed twice, by a worker that seemed lost and by another one. Each attempt has a file of its
own, which gets its name when it is complete. One attempt of each piece is merged; the others are deleted.
"""

from __future__ import annotations

import hashlib
import secrets
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.runs.blas import one_blas_thread
from ipsys_log.runs.piece_file import from_bytes, to_bytes
from ipsys_log.runs.pieces import Piece, PiecePlan, PieceResult, PieceRun, check_versions, compute_piece
from ipsys_log.runs.provenance import fingerprint

_COMPLETE, _PARTIAL = ".piece", ".partial"


class OtherSoftwareError(IpsysError):
    """A worker with other versions of libraries than the process that divided the run."""


@dataclass(frozen=True, slots=True, eq=False)
class PieceTask:
    """The work on one piece, for any process that sees its logs and its folder.

    Attributes
    ----------
    key : identifies the result by content.
    software : the versions on which the digits of the result depend.
    """

    run: PieceRun
    piece: Piece
    key: str
    folder: Path
    software: Mapping[str, str]


class PiecesMissingError(Exception):
    """The interruption of a replay: these pieces must be computed first."""

    def __init__(self, tasks: list[PieceTask]) -> None:
        super().__init__(f"{len(tasks)} pieces are missing")
        self.tasks = tasks


@dataclass(slots=True)
class PieceFolder:
    """The folder with the attempts at the pieces of a log's run, beside the log with the results."""

    path: Path

    @staticmethod
    def beside(target: Path) -> PieceFolder:
        """Return the folder for the pieces of a log."""
        return PieceFolder(target.absolute().with_name(f"{target.name}.pieces"))

    def attempts(self) -> dict[str, list[Path]]:
        """Return the complete attempts by key, sorted by name."""
        found: dict[str, list[Path]] = {}
        for file in sorted(self.path.glob(f"*{_COMPLETE}")):
            found.setdefault(file.name.partition(".")[0], []).append(file)
        return found

    def write(self, key: str, data: bytes) -> None:
        """Write an attempt. If the folder does not exist any more, the result has been merged: do nothing."""
        partial = self.path / f"{key}.{secrets.token_hex(4)}{_PARTIAL}"
        with suppress(FileNotFoundError):
            try:
                with partial.open("xb") as file:
                    file.write(data)
                partial.rename(partial.with_suffix(_COMPLETE))
            finally:
                partial.unlink(missing_ok=True)

    def clear(self, merged: Collection[str]) -> int:
        """Delete the folder; return the number of further attempts at the pieces with ``merged`` keys."""
        # Under its new name, no late attempt comes into the folder.
        old = self.path.with_name(f"{self.path.name}.{secrets.token_hex(4)}")
        try:
            self.path.rename(old)
        except FileNotFoundError:
            return 0
        count = sum(file.name.partition(".")[0] in merged for file in old.iterdir())
        shutil.rmtree(old, ignore_errors=True)
        return max(count - len(merged), 0)


@dataclass(slots=True)
class StoredPieces:
    """The pieces of a long run from a folder; the interface of :class:`~ipsys_log.runs.pieces.PieceWorkers`.

    Attributes
    ----------
    keys : of the pieces of the run, as soon as all of them are stored.
    merged : the number of those that were merged.
    """

    folder: PieceFolder
    keys: tuple[str, ...] = ()
    merged: int = 0
    divides: bool = field(default=True, init=False)

    @property
    def is_complete(self) -> bool:
        """True if all pieces of a run were merged."""
        return 0 < len(self.keys) == self.merged

    def prepare(self, plan: PiecePlan) -> None:
        """Do nothing: the results are stored."""

    def compute(self, plan: PiecePlan) -> Iterator[PieceResult]:
        """Yield the results in the folder, in the order of the plan.

        Raises
        ------
        PiecesMissingError
            Some results are missing or damaged.
        """
        interim = plan.run.load().interim  # imports the stage: its libraries are in the fingerprint
        software = fingerprint()
        keys = _keys(plan, software)
        attempts = self.folder.attempts()

        def missing(places: list[int]) -> PiecesMissingError:
            self.folder.path.mkdir(exist_ok=True)
            run, folder = plan.run, self.folder.path
            return PiecesMissingError(
                [PieceTask(run, plan.pieces[n], keys[n], folder, software) for n in places]
            )

        if places := [n for n, key in enumerate(keys) if key not in attempts]:
            raise missing(places)
        self.keys = tuple(keys)
        for n, key in enumerate(keys):
            result = _first_complete(attempts[key], interim)
            if result is None:
                raise missing([n])
            self.merged += 1  # before the yield: the iteration can end with the last result
            yield result


def store_piece(task: PieceTask) -> None:
    """Compute a piece, and write its result into the folder.

    Raises
    ------
    OtherSoftwareError
        This process has other versions of libraries than the process that planned the pieces.
    IpsysError
        A log has changed since the pieces were planned, or cannot be opened.
    OSError
        The result cannot be written.
    """
    task.run.load()
    software = fingerprint()
    if software != task.software:
        names = [name for name in task.software if software.get(name) != task.software[name]]
        raise OtherSoftwareError(f"the workers have different versions: {', '.join(names)}")
    with Session(task.run.paths) as session, one_blas_thread():
        check_versions(session, task.run)
        result = compute_piece(session, task.run, task.piece)
        check_versions(session, task.run)
    PieceFolder(task.folder).write(task.key, to_bytes(result))


def _keys(plan: PiecePlan, software: Mapping[str, str]) -> list[str]:
    """Return the name of each piece's result, from everything on which the result depends."""
    common = repr((plan.identity(), sorted(software.items())))
    return [
        hashlib.blake2b(repr((common, *piece)).encode(), digest_size=16).hexdigest() for piece in plan.pieces
    ]


def _first_complete(files: list[Path], interim: tuple[type, ...]) -> PieceResult | None:
    """Return the first undamaged result of some attempts; delete the damaged ones.

    Another process that merges the same log may delete all of them meanwhile.
    """
    for file in files:
        with suppress(FileNotFoundError):
            result = from_bytes(file.read_bytes(), interim)
            if result is not None:
                return result
            file.unlink()
    return None
