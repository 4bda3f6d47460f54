"""New logs from the messages of others: ``ipsys cut`` and ``ipsys merge``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import console, print_result, progress_bar, say
from ipsys_log.app.cli.options import flag, log_argument, log_option, option, setting, with_options
from ipsys_log.app.report.rows import counted
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation
from ipsys_log.plain_text import shell_words
from ipsys_log.units import format_bytes

if TYPE_CHECKING:
    from ipsys_log.tools.cut import DroppedRun
    from ipsys_log.tools.merge_plan import LogOffset

_NEW_LOG = "The log to write, with a name that ends in .mcap."
_TIME = "UTC, such as '2026-05-04 10:00:00', or seconds from the start of the log."


# The options that select a part, as the fields of `CutOptions`.
_SELECTION: dict[str, cli.Option] = {
    "start": option(str, "--start", "TIME", f"Keep messages from this time on: {_TIME}", ""),
    "end": option(str, "--end", "TIME", f"Keep messages before this time: {_TIME}", ""),
    "topics": option(
        list[str] | None, "--topics", "PATTERN",
        "Keep topics of this pattern, such as '/cameras/*'; repeat it for several.",
    ),
    "exclude_topics": option(
        list[str] | None, "--exclude-topics", "PATTERN",
        "Leave out topics of this pattern; repeat it for several.",
    ),
    "cameras": option(
        list[str] | None, "--cameras,--camera", "NAME", "Keep this camera; repeat it for several."
    ),
    "runs": option(list[str] | None, "--runs,--run", "NAME", "Keep this run; repeat it for several."),
    "exclude_runs": option(
        list[str] | None, "--exclude-runs,--exclude-run", "NAME",
        "Leave out this run with its record; repeat it for several.",
    ),
    "robots": option(
        list[str] | None, "--robots,--robot", "NAME",
        "Keep the frames that show this robot, with their results; repeat it for several.",
    ),
    "every": option(
        int, "--every", "N", "Keep each n-th frame of each camera, with its results.", 1, min=1
    ),
}  # fmt: skip


@with_options(
    {
        "logs": (cli.ReadLogs, cli.REQUIRED),
        "output": (Annotated[Path | None, log_option(help=_NEW_LOG)], None),
        **_SELECTION,
        "compact": flag(
            "--compact", "Leave out superseded and unfinished runs, and keep everything else of one LOG."
        ),
        "dry_run": flag("--dry-run", "With --compact: only list these runs, and write nothing."),
        "overwrite": (cli.Overwrite, False),
        "as_json": (cli.AsJson, False),
    }
)
def cut(
    logs: Sequence[LogLocation],
    output: Path | None,
    compact: bool,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
    **selection: Any,
) -> None:
    """Write a part of a log to a new log: a time range, some topics, cameras, runs, robots or frames.

    The messages stay as they are. Rig, intrinsics, models, measurements and the records of runs come with
    every part. The new log names the log that it was cut from, and ipsys verify checks its messages.

    A run is superseded if newer complete runs of the same name, settings and kind of input replace all its
    stages: poly_2 supersedes poly. --compact keeps runs that a kept run has read, and the provenance of all.
    Another log may have results of a dropped run as its input: ipsys info --runs lists the input runs.

    Examples

        ipsys cut monday.mcap -o part.mcap --start 60 --end 90
        ipsys cut monday.mcap -o part.mcap --start '2026-05-04 10:00' --camera red
        ipsys cut monday.mcap -o small.mcap --exclude-topics '/cameras/*/image'
        ipsys cut monday.mcap -o poly.mcap --run poly
        ipsys cut calibration.mcap --compact --dry-run     # which runs, how much?
    """
    from ipsys_log.tools.cut import cut as cut_logs
    from ipsys_log.tools.cut_selection import CutOptions

    chosen: dict[str, Any] = {name: value for name, value in selection.items() if value is not None}
    options = CutOptions(**chosen)
    if compact:
        if options.as_text():
            raise IpsysError("--compact: cannot be used with options that select a part; cut again for these")
        _compact(logs, output, dry_run, overwrite, as_json)
        return
    if dry_run:
        raise IpsysError("--dry-run: has no effect without --compact")
    if output is None:
        raise IpsysError("-o is missing; give the name of the new log")
    with progress_bar() as progress:
        result = cut_logs(logs, output, options, overwrite, progress)
    size = output.stat().st_size
    text = f"{result.kept} of {result.messages} messages, {result.channels} channels, {format_bytes(size)}"
    value = {"output": str(output), **result._asdict(), "bytes": size}
    print_result(value, [f"{output} written: {text}"], as_json)


def _compact(
    logs: Sequence[LogLocation], output: Path | None, dry_run: bool, overwrite: bool, as_json: bool
) -> None:
    """Copy a log without its superseded and unfinished runs, or list them."""
    from ipsys_log.engine.output import check_copy
    from ipsys_log.log.log_files import read_log_state
    from ipsys_log.tools.cut import compact, dropped_runs

    if len(logs) != 1:
        raise IpsysError("--compact: compacts one log; name only one")
    if output is None and not dry_run:
        raise IpsysError("-o is missing; give the name of the new log, or --dry-run")
    (log,) = logs
    if output is not None:
        check_copy([log], output, overwrite)
    dropped, size = dropped_runs(log), read_log_state(log).size
    written = output if dropped and not dry_run else None
    for line in () if as_json else _dropped_lines(log, size, dropped):
        console.print(line)
    after, saved = None, []
    if written is not None:
        with progress_bar() as progress:
            compact(log, written, overwrite, progress)
        after = written.stat().st_size
        saved = [f"{written} written: {format_bytes(after)} instead of {format_bytes(size)}"]
    value = {
        "log": str(log),
        "output": None if written is None else str(written),
        "bytes": size,
        "output_bytes": after,
        "dropped": [
            {
                "run": one.run.run,
                "reason": one.run.reason,
                "stages": one.run.stages,
                "messages": one.messages,
                "stored_bytes": one.stored_bytes,
            }
            for one in dropped
        ],
    }
    print_result(value, saved, as_json)


def merge(
    logs: Annotated[
        cli.LogList,
        log_argument(help="The logs of the recorders, files or URLs. The clock of the first log counts."),
    ],
    output: cli.NewLog,
    offset: Annotated[
        list[str] | None,
        setting(
            "--offset",
            "NAME=SECONDS",
            "Add these seconds to all times of a log, such as monday_b=0.012; repeat it for several.",
        ),
    ] = None,
    overwrite: cli.Overwrite = False,
    as_json: cli.AsJson = False,
) -> None:
    """Merge the logs of several recorders of one session, with different cameras, into a new log.

    Each recorder has its own clock. Without --offset, the command estimates the offset of a log from moving
    markers that its cameras and those of an earlier log saw. Run ipsys replay --until detect on both logs
    first. Rigs and intrinsics must not contradict each other, and each run has its results in one log only:
    markers of other cameras join the run of the same name. The new log has the record of the merge with all
    offsets.

    Examples

        ipsys merge monday_a.mcap monday_b.mcap -o monday.mcap
        ipsys merge a.mcap b.mcap c.mcap -o day.mcap --offset b=0.012 --offset c=-1
    """
    from ipsys_log.engine.output import check_copy
    from ipsys_log.tools.merge import choose_offsets
    from ipsys_log.tools.merge import merge as merge_logs

    check_copy(logs, output, overwrite)
    with progress_bar() as progress:
        offsets = choose_offsets(logs, offset or (), progress)
        result = merge_logs(logs, output, offsets, overwrite, progress)
    lines = _offset_lines(logs, offsets)
    written = f"{output} written: {result.messages} messages, {format_bytes(output.stat().st_size)}"
    rows = [
        {"name": log.name, "offset_ns": log.offset_ns, "offset_sigma_s": log.offset_sigma_s}
        for log in result.logs
    ]
    value = {"output": str(output), "messages": result.messages, "logs": rows}
    print_result(value, [*lines, written], as_json)
    if not as_json:
        say(f"next: ipsys replay {shell_words(output)}")


def _dropped_lines(log: LogLocation, size: int, dropped: list[DroppedRun]) -> Iterator[str]:
    if not dropped:
        yield f"{log}: no run is superseded or unfinished; nothing is written"
        return
    for one in dropped:
        count, stored = counted(one.messages, "message"), format_bytes(one.stored_bytes)
        yield f"{one.run.run} is dropped: {one.run.reason}; {count}, about {stored}"
    gained = sum(one.stored_bytes for one in dropped)
    yield f"{counted(len(dropped), 'run')}, about {format_bytes(gained)} of {format_bytes(size)}"


def _offset_lines(logs: Sequence[LogLocation], offsets: Sequence[LogOffset]) -> Iterator[str]:
    for path, offset in zip(logs[1:], offsets[1:], strict=True):
        sigma = "" if offset.sigma_s is None else f" (estimated, sigma {offset.sigma_s * 1e3:.2f} ms)"
        yield f"{path}: {offset.offset_ns / 1e9:+.6f} s are added to its times{sigma}"
