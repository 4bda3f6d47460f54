"""Check of the file of a log: every record, CRC and index, without any change of the file."""

from collections.abc import Mapping
from dataclasses import dataclass

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.contents import Contents
from ipsys_log.log.damage.agreement import disagreement
from ipsys_log.log.damage.findings import Survey, Watch
from ipsys_log.log.damage.survey import survey
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.summary import read_intact_summary


@dataclass(frozen=True, slots=True)
class FileCheck:
    """The result of the check of a file.

    ``faults`` are the faults in words, in the order of the file. ``interrupted`` says that an append was
    interrupted, so that readers use the log before it. ``changed_topics`` have other messages than the stored
    hash of their writer says.
    """

    faults: tuple[str, ...] = ()
    interrupted: bool = False
    changed_topics: tuple[str, ...] = ()


def check_file(
    view: LogBytes, contents: Contents, stored: Mapping[str, ChannelHash], watch: Watch
) -> FileCheck:
    """Read a log completely, and compare its data section, its indexes and its summary.

    Parameters
    ----------
    contents : the table of contents that readers use.
    stored : the hashes that writers stored in the log, by topic.
    watch : follows the reading.

    Raises
    ------
    BoundError
        The log exceeds the limits of its file size.
    """
    findings = survey(view, read_intact_summary(view), watch=watch)
    faults = _faults_before(contents.data_end, findings) if contents.cut_short else _faults(view, findings)
    changed = [
        topic
        for topic, state in sorted(findings.hashes.items())
        if topic in stored and state.valid and _differs(state, stored[topic])
    ]
    return FileCheck(faults, contents.cut_short or view.is_interrupted, tuple(changed))


def _faults(view: LogBytes, findings: Survey) -> tuple[str, ...]:
    difference = disagreement(view, findings)
    if not difference:
        return ()
    if findings.faults:
        return tuple(findings.faults)
    if findings.finished and not findings.crc_is_right:
        return ("the CRC of the data section is wrong; the position of the damage is unknown",)
    return (difference,)


def _faults_before(data_end: int, findings: Survey) -> tuple[str, ...]:
    """Return the damage before `data_end`: after it, there are parts of an interrupted append."""
    ranges = [*findings.damaged, *([findings.cut] if findings.cut is not None else [])]
    return tuple(
        f"bytes {part.offset} to {min(part.end, data_end)} cannot be read"
        for part in ranges
        if part.offset < data_end
    )


def _differs(state: ChannelHash, stored: ChannelHash) -> bool:
    return state.count == stored.count and state.digest != stored.digest
