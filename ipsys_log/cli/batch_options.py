"""The options of ``ipsys batch``: logs, folders, workers and the result, and those of each command."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any

import typer

from ipsys_log.cli.options import AsJson, LogList, log_argument

_Path = Path | None
_Text = str | None
LOGS = (
    Annotated[
        LogList,
        log_argument(
            help="Logs, files or URLs, each one on its own. A folder, or a URL that ends with /, stands for "
            "all logs below it."
        ),
    ],
    inspect.Parameter.empty,
)
FOLDER = (
    Annotated[
        _Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="The folder for the results of logs that cannot be appended to: URLs and read-only files. "
            "Default: the working folder.",
        ),
    ],
    None,
)
_DERIVED_HELP = (
    "The folder of -o in ipsys batch replay, with the results of logs that cannot be appended to. Each log "
    "is read together with its derived log. Default: the working folder."
)
DERIVED = (
    Annotated[_Path, typer.Option("--derived", "-o", metavar="FOLDER", help=_DERIVED_HELP)],
    None,
)
# The options of the workers and of the result, which all commands of the group have.
WORKERS: dict[str, tuple[Any, Any]] = {
    "scheduler": (
        Annotated[
            _Text,
            typer.Option(
                metavar="ADDRESS",
                help="Use the workers of this Dask scheduler, such as tls://head:8786. Access to a scheduler "
                "means code execution on its workers, so it must use certificates. Default: processes on "
                "this machine.",
            ),
        ],
        None,
    ),
    "workers": (
        Annotated[
            int | None,
            typer.Option(
                min=1, metavar="N", help="Worker processes on this machine. Default: one for each core."
            ),
        ],
        None,
    ),
    "memory_limit": (
        Annotated[
            _Text,
            typer.Option(
                metavar="SIZE", help="Memory of each worker process, such as 2GB. Default: an equal share."
            ),
        ],
        None,
    ),
    "tls_ca": (
        Annotated[_Path, typer.Option(metavar="FILE", help="Certificate of the authority, for --scheduler.")],
        None,
    ),
    "tls_cert": (
        Annotated[_Path, typer.Option(metavar="FILE", help="Your certificate, for --scheduler.")],
        None,
    ),
    "tls_key": (
        Annotated[_Path, typer.Option(metavar="FILE", help="The key of your certificate, for --scheduler.")],
        None,
    ),
    "insecure": (
        Annotated[
            bool,
            typer.Option(
                "--insecure",
                help="Permit a scheduler without certificates: each program that reaches it can run code.",
            ),
        ],
        False,
    ),
    "table": (
        Annotated[
            _Path,
            typer.Option(metavar="FILE", help="Write the results to a Parquet file: a row for each log."),
        ],
        None,
    ),
    "as_json": (AsJson, False),
}
OUTDATED = (
    Annotated[bool, typer.Option("--outdated", help="Replay only logs that hold outdated runs.")],
    False,
)
RUN = (Annotated[_Text, typer.Option("--run", metavar="NAME", help="Use only this run.")], None)
EXPORT: dict[str, tuple[Any, Any]] = {
    "output": (
        Annotated[
            Path,
            typer.Option(
                "--output",
                "-o",
                metavar="FOLDER",
                help="The folder for the files, named as the logs. They keep the folders of the logs below "
                "the folder or pattern that you name.",
            ),
        ],
        inspect.Parameter.empty,
    ),
    "format_": (
        Annotated[
            str,
            typer.Option("--format", metavar="NAME", help="csv, parquet, tum, kitti, ros2, mp4 or coco."),
        ],
        "csv",
    ),
    "channel": (
        Annotated[
            str,
            typer.Option(
                metavar="NAME",
                help="The table to export: tracks, positions, markers, camera_points, measurements, events, "
                "latency or truth.",
            ),
        ],
        "tracks",
    ),
    "run": (
        Annotated[
            _Text, typer.Option("--run", metavar="NAME", help="Export this run instead of the newest.")
        ],
        None,
    ),
    "robot": (Annotated[_Text, typer.Option(metavar="NAME", help="Export only this robot.")], None),
    "derived": (Annotated[_Path, typer.Option("--derived", metavar="FOLDER", help=_DERIVED_HELP)], None),
    "overwrite": (
        Annotated[bool, typer.Option("--overwrite", help="Export all logs, also those with a newer file.")],
        False,
    ),
}
