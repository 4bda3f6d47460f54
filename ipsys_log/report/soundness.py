"""The result of a check of logs as text and as plain data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from ipsys_log.plain_text import plain_text
from ipsys_log.soundness.finding import BROKEN, SOUND, UNREAD, LogCheck, LogFinding
from ipsys_log.units import format_time

_MOST_LINES = 30


def check_json(checks: Sequence[LogCheck]) -> dict[str, Any]:
    """Return the results as plain data; notes are included, and missing values are left out."""
    return {
        "state": LogCheck.worst(checks),
        "logs": [
            {
                "path": str(check.path),
                "state": check.state,
                "findings": [_finding_json(finding) for finding in check.findings],
            }
            for check in checks
        ],
    }


def _finding_json(finding: LogFinding) -> dict[str, Any]:
    return {key: value for key, value in asdict(finding).items() if value not in (None, "")}


def check_lines(check: LogCheck, details: bool = False) -> Iterator[str]:
    """Yield the answer for a log, then a line for each finding; notes only with ``details``."""
    findings = check.findings if details else check.remarks
    yield f"{check.path}: {_answer(check)}"
    for finding in findings[:_MOST_LINES]:
        if finding is not _first_fault(check):
            yield f"  {_line(finding)}"
        elif finding.advice:
            yield f"  {finding.advice}"
    if len(findings) > _MOST_LINES:
        yield f"  and {len(findings) - _MOST_LINES} more: --json lists all"


def _first_fault(check: LogCheck) -> LogFinding | None:
    return next((finding for finding in check.findings if finding.level in (BROKEN, UNREAD)), None)


def _answer(check: LogCheck) -> str:
    fault = _first_fault(check)
    if fault is not None:
        return f"{check.state}: {plain_text(fault.text)}"
    number = len(check.remarks)
    return SOUND if not number else f"readable, {number} remark{'s' if number > 1 else ''}"


def _line(finding: LogFinding) -> str:
    """Return the place, the fault and the advice of a finding in one line."""
    place = [finding.topic] if finding.topic else []
    place += [f"at {format_time(finding.time_ns)}"] if finding.time_ns is not None else []
    place += [f"({finding.count} messages)"] if finding.count is not None and finding.count > 1 else []
    title = f"{' '.join(place)}: " if place else ""
    advice = f"; {finding.advice}" if finding.advice else ""
    return plain_text(f"{title}{finding.text}{advice}")
