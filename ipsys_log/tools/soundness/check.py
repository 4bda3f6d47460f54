"""The check of a log: its file first, then its channels, references and runs."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress

from ipsys_log.engine.graph import writes
from ipsys_log.engine.request import Progress
from ipsys_log.engine.states import Recorded, is_fitted_here, recorded_stages
from ipsys_log.errors import IpsysError, UnreadError, os_error_text, reason_without
from ipsys_log.log.byte_source import BoundError
from ipsys_log.log.contents import StoredChannel, camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.log.reader import LogReader
from ipsys_log.log.survey import Watch
from ipsys_log.messages import IMPORTED
from ipsys_log.messages.channels import IMAGES, MODEL, RECORD, clock_topic
from ipsys_log.plain_text import shell_words
from ipsys_log.tools.soundness.channels import (
    check_events,
    check_messages,
    check_rates,
    check_schemas,
    decoded_topics,
    image_topics,
)
from ipsys_log.tools.soundness.finding import BROKEN, NOTE, REMARK, UNREAD, LogCheck, LogFinding
from ipsys_log.tools.soundness.references import (
    MessageTimes,
    check_cameras,
    check_clocks,
    check_intrinsics,
    check_measurements,
    check_rigs,
)

_BYTES_PER_MB = 1_000_000
# Logs without images are smaller: their markers are the start of all later stages.
_IMAGE_NAME = IMAGES.topic.rpartition("/")[2]


@one_reading()
def check_logs(
    paths: Sequence[LogLocation], progress: Progress = lambda stage, done, total: None
) -> tuple[LogCheck, ...]:
    """Read logs completely, and check each of them; no file is changed.

    A log may have runs whose inputs are in another of the given logs.

    Parameters
    ----------
    progress : called with the name of the step, the amount done, and the total amount.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from ipsys_log.log.writer import LogWriter
    >>> with TemporaryDirectory() as folder:
    ...     with LogWriter.create(Path(folder) / "a.mcap"):
    ...         pass
    ...     [check] = check_logs([Path(folder) / "a.mcap"])
    >>> check.state, check.findings
    ('sound', ())
    """
    return tuple(_check_log(path, [other for other in paths if other != path], progress) for path in paths)


def _check_log(path: LogLocation, others: Sequence[LogLocation], progress: Progress) -> LogCheck:
    findings: list[LogFinding] = []
    try:
        findings += _check_file(path, progress)
        if not any(finding.level == BROKEN for finding in findings):
            findings += _check_contents(path, others, progress)
    except UnreadError as error:
        findings.append(LogFinding("file", UNREAD, reason_without(path, error)))
    except OSError as error:  # of the disk
        findings.append(LogFinding("file", UNREAD, reason_without(path, IpsysError(os_error_text(error)))))
    except IpsysError as error:
        findings.append(LogFinding("file", BROKEN, reason_without(path, error)))
    return LogCheck(path, tuple(findings))


def _check_file(path: LogLocation, progress: Progress) -> Iterator[LogFinding]:
    advice = f"run: ipsys repair {shell_words(path)}"
    with LogReader(path) as reader:
        times = MessageTimes(_stamped_topics(reader.channels))
        total = reader.size // _BYTES_PER_MB

        def show(checked: int) -> None:
            progress("check MB", checked // _BYTES_PER_MB, total)

        result = reader.check_file(Watch(show, times.add))
    for fault in result.faults:
        yield LogFinding("file", BROKEN, fault, advice)
    if result.faults:
        return
    if result.interrupted:
        text = "an append was interrupted: ipsys reads the log before it"
        yield LogFinding("file", REMARK, text, advice)
    for topic in result.changed_topics:
        text = "another program changed messages: they do not match the hash that their writer stored"
        yield LogFinding("file", REMARK, text, "ask its sender for the original log", topic)
    yield from times.findings()


def _stamped_topics(channels: Mapping[str, StoredChannel]) -> set[str]:
    """Return the topics of images whose publish times are the stamps of a camera, in increasing order.

    A bag of ROS 2 has its stamps in the messages. Late frames of a node come after newer ones.
    """
    return {
        topic
        for topic in image_topics(channels)
        if channels[topic].message_encoding != "cdr"
        and clock_topic(str(camera_of_topic(topic))) not in channels
    }


def _check_contents(
    path: LogLocation, others: Sequence[LogLocation], progress: Progress
) -> Iterator[LogFinding]:
    with ExitStack() as stack:
        session = stack.enter_context(Session([path]))
        total = sum(session.count(topic) for topic in decoded_topics(session))
        yield from _findings("schema", check_schemas(session))
        yield from _findings("message", check_messages(session, lambda done: progress("decode", done, total)))
        yield from _findings("rate", check_rates(session))
        yield from _findings("event", check_events(session))
        whole, names = session, session.run_names()
        sources = _find_input_logs(session, others)
        if sources:
            whole = stack.enter_context(Session([*sources, path]))
        for check in (check_rigs, check_cameras, check_intrinsics, check_measurements):
            yield from _findings("reference", check(whole))
        yield from _findings("time", check_clocks(whole))
        yield from _findings("run", _check_runs(whole, names))


def _findings(kind: str, part: Iterator[LogFinding]) -> Iterator[LogFinding]:
    """Yield the findings of a part of the check; a fault that stops it is one more finding."""
    try:
        yield from part
    except (BoundError, UnreadError):
        raise
    except IpsysError as error:
        yield LogFinding(kind, REMARK, str(error), "later messages of this kind are not checked")


def _find_input_logs(session: Session, others: Sequence[LogLocation]) -> list[LogLocation]:
    """Return the logs among ``others`` with inputs of runs that the log of ``session`` lacks in part."""
    needed = {
        read.topic: read.hash
        for run in session.runs()
        for read in run.inputs
        if read.messages != session.count(read.topic)
    }
    return [path for path in others if needed and _has_input(path, needed)]


def _has_input(path: LogLocation, needed: dict[str, str]) -> bool:
    with suppress(IpsysError), Session([path]) as other:
        # An input from several logs has the hash of each of them, joined by "+".
        return any(
            other.count(topic) and other.hash(topic) in wanted.split("+") for topic, wanted in needed.items()
        )
    return False


def _check_runs(session: Session, names: Collection[str]) -> Iterator[LogFinding]:
    """Check the runs with these names: their records, their inputs and their states."""
    recorded = recorded_stages(session)
    for stage in recorded:
        if stage.run.run in names:
            yield _check_stage(session, stage)
    for name in sorted(set(names) - {stage.run.run for stage in recorded}):
        text = f"run {name} has no record: its writer was stopped"
        yield LogFinding("run", REMARK, text, "ipsys replay computes it again", RECORD.topic_of(name))


def _check_stage(session: Session, stage: Recorded) -> LogFinding:
    run = stage.run
    text = f"run {run.run}, {run.stage}: {stage.state}"
    topic = RECORD.topic_of(run.run)
    missing = [read.topic for read in run.inputs if read.messages and not session.count(read.topic)]
    is_copy = run.stage == IMPORTED or (writes(run, MODEL) and not is_fitted_here(run))
    if stage.is_newer:
        return LogFinding("run", REMARK, text, "", topic)
    if stage.state == "unfinished" or stage.out_of_date:
        return LogFinding("run", REMARK, text, "ipsys replay computes it again", topic)
    if any(not topic.endswith(f"/{_IMAGE_NAME}") for topic in missing) and not (is_copy or stage.is_copied):
        text = f"run {run.run}, {run.stage}: its input {missing[0]} is not in the log"
        return LogFinding("run", REMARK, text, "give the log with this input too", topic)
    return LogFinding("run", NOTE, text, "", topic)
