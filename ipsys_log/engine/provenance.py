"""Provenance of runs: names, inputs, fingerprints, versions of stages; and by it, log times of channels.

A version rises by one with each change of the output for the same input. The parameters of a run name its
versions, except version 1. Versions of packages make no run out of date: they are in its fingerprint.
"""

import platform
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from typing import NamedTuple

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, CameraCalibration, ChannelRead, ChannelWritten, Run
from ipsys_log.messages.channels import MARKERS, Channel

# The parameter ``format`` of the record of markers that nodes have sent.
NODE_FORMAT = "node"
_MOST_DIGITS = 6


def recorded_version(run: Run, name: str) -> int:
    """Return the version of a stage, method or model that made a run."""
    text = run.parameters.get(name, "1")
    return int(text) if text.isascii() and text.isdigit() and len(text) <= _MOST_DIGITS else 1


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a stage: its run, whether it was made now, and remarks."""

    stage: str
    run: str
    fresh: bool
    messages: int = 0
    remarks: tuple[str, ...] = ()


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    packages = ("ipsys_log", "numpy", "scipy", "scikit-learn", "opencv-python-headless", "simplejpeg")
    return (("python", platform.python_version()), *((name, version(name)) for name in packages))


def fingerprint() -> dict[str, str]:
    """Return the environment on which the digits of a result can depend: versions and BLAS kernel."""
    import scipy.linalg  # noqa: F401 - its BLAS must be loaded to be named

    kernels = {
        f"{library.get('internal_api')} {library.get('version')} {library.get('architecture', '')}".strip()
        for library in threadpoolctl.threadpool_info()
        if library.get("user_api") == "blas"
    }
    return {**dict(_versions()), "machine": platform.machine(), "blas": ", ".join(sorted(kernels))}


def read_channels(session: Session, topics: Iterable[str]) -> tuple[ChannelRead, ...]:
    """Return the input of a stage by topic, identified by its content (law 4 of the log)."""
    return tuple(ChannelRead(topic, session.count(topic), session.hash(topic)) for topic in sorted(topics))


def _identity(run: Run) -> bytes:
    """Return the identity of a run of a stage: all fields except names, times and the environment."""
    return encode(replace(run, timestamp=0, run="", fingerprint={}, input_runs=(), outputs=(), number=0))


def replaced_lenses(run: Run) -> dict[str, CameraCalibration]:
    """Return the intrinsics that replaced those of the log in a run."""
    return {
        lens.camera: CameraCalibration(
            0, lens.camera, lens.width, lens.height, lens.distortion_model, lens.d, lens.k
        )
        for lens in run.lenses
    }


class Original(NamedTuple):
    """A channel before a cut or a merge has copied it: the number and hash of its messages, and its logs."""

    messages: int
    hash: str
    logs: tuple[str, ...]


def originals(session: Session, topic: str) -> Iterator[Original]:
    """Yield a channel before each cut and each merge, the last one first.

    A record of a copy counts only if the channel is now, or was before a later copy, as it says.
    """
    readers = [reader for reader in session.readers if topic in reader.channels]
    if len(readers) > 1:  # the channel goes on in a second log, which the record does not know
        return
    states = {(session.count(topic), session.hash(topic))} if session.copies else set()
    for reader in readers or session.copies:
        for copy in reversed(session.copies.get(reader, [])):
            before = next((one for one in copy.channels if one.topic == topic and not one.shared), None)
            if before is not None and (before.kept, before.kept_hash or "") in states:
                states.add((before.messages, before.hash))
                yield Original(before.messages, before.hash, copy.logs)


def is_whole(session: Session, read: ChannelRead) -> bool:
    """Return whether a channel is now as a stage has read it."""
    return session.count(read.topic) == read.messages and session.hash(read.topic) == read.hash


def original_of(session: Session, read: ChannelRead) -> Original | None:
    """Return a channel as a stage has read it, before a cut or a merge; None if it never was so."""
    same = [one for one in originals(session, read.topic) if one[:2] == (read.messages, read.hash)]
    return same[-1] if same else None


def _original_with(session: Session, output: ChannelWritten) -> Original | None:
    """Return a channel with all messages of a stage, before a cut or a merge; None if it never was so."""
    whole = [one for one in originals(session, output.topic) if one.messages >= output.messages]
    return whole[-1] if whole else None


def copied_from(session: Session, run: Run) -> tuple[str, ...]:
    """Return the logs from which a stage of a run was copied, if the copy has only a part of its channels.

    Returns
    -------
    () if all its channels are whole, or if one of them has changed since in another way.
    """
    changed = [original_of(session, read) for read in run.inputs if not is_whole(session, read)]
    changed += [_original_with(session, output) for output in run.outputs if not _has_all(session, output)]
    logs = [one.logs for one in changed if one is not None]
    return logs[0] if logs and len(logs) == len(changed) else ()


def complete_runs(session: Session) -> list[Run]:
    """Return the records whose channels are all in the log, oldest first."""
    return [run for run in session.runs() if is_complete(session, run)]


def is_complete(session: Session, run: Run) -> bool:
    """Return whether all channels of a stage are in the log, or were in the log from which it was copied."""
    return all(
        _has_all(session, output) or _original_with(session, output) is not None for output in run.outputs
    )


def _has_all(session: Session, output: ChannelWritten) -> bool:
    return session.count(output.topic) >= output.messages


def find_run(session: Session, wanted: Run, purpose: Channel, name: str | None = None) -> str | None:
    """Return the name of the newest complete run with the inputs and parameters of ``wanted``, if any.

    A copied run is found if its inputs were only copied, in part or with other times, and not changed.

    ``purpose`` is the channel of the result, of which a copy must have a part.
    """
    essence = _identity(wanted)
    for run in reversed(complete_runs(session)):
        if run.stage == wanted.stage and name in (None, run.run):
            inputs = tuple(now for read in run.inputs if (now := _as_copied(session, read)) is not None)
            if _identity(replace(run, inputs=inputs)) == essence and _has_result(session, run, purpose):
                return run.run
    return None


def _as_copied(session: Session, read: ChannelRead) -> ChannelRead | None:
    """Return an input of a run as it is here, if it was only copied; None if the copy has nothing of it."""
    if is_whole(session, read) or original_of(session, read) is None:
        return read
    count = session.count(read.topic)
    return ChannelRead(read.topic, count, session.hash(read.topic)) if count else None


def _has_result(session: Session, run: Run, purpose: Channel) -> bool:
    """Return whether the log has a part of the result of a run, if there was any."""
    results = [
        output
        for output in run.outputs
        if output.messages and purpose.topic_of(run.run, camera_of_topic(output.topic)) == output.topic
    ]
    return not results or any(session.count(output.topic) for output in results)


def with_inputs(names: Iterable[str], reads: Mapping[str, Collection[str]]) -> set[str]:
    """Return runs and all runs that they have read, directly or through others.

    Parameters
    ----------
    reads : by run, the runs that its stages have read.

    Examples
    --------
    >>> sorted(with_inputs(["poly"], {"poly": ["edges"], "edges": ["edges"], "rigid": ["stock"]}))
    ['edges', 'poly']
    """
    waiting, reached = list(names), set(names)
    while waiting:
        new = set(reads.get(waiting.pop(), ())) - reached
        reached |= new
        waiting += new
    return reached


def free_name(session: Session, record: Run, base: str, writes: Sequence[Channel]) -> str:
    """Return the name for a new run: ``base``, or ``base_2``, ``base_3`` ... if ``base`` is taken.

    A stage joins the run that it reads from, if that run does not have the stage yet. Any other name must
    be new: a run holds only results that belong together.
    """
    taken = session.run_names()
    joins = base in record.input_runs and not _has_stage(session, record.stage, base, writes)
    if joins or base not in taken:
        return base
    number = 2
    while f"{base}_{number}" in taken:
        number += 1
    return f"{base}_{number}"


def next_number(session: Session) -> int:
    """Return the number of the next run of a log."""
    return max((run.number for run in session.runs()), default=0) + 1


def new_run(
    session: Session, record: Run, base: str, topics: Sequence[str], writes: Sequence[Channel] = ()
) -> tuple[Run, int]:
    """Return the record of a run with its name, its number and the time of its last input; and its log time.

    Parameters
    ----------
    record : stage, parameters and inputs.
    base, writes : as for :func:`free_name`.
    topics : the inputs in this log.
    """
    log_time_ns, time_ns = session.last(topics)
    record = replace(
        record,
        timestamp=time_ns,
        run=free_name(session, record, base, writes),
        fingerprint=fingerprint(),
        number=next_number(session),
    )
    return record, log_time_ns


def _has_stage(session: Session, stage: str, name: str, writes: Sequence[Channel]) -> bool:
    """Return whether a run has a stage, by its record or by the first channel that the stage writes."""
    recorded = any((run.run, run.stage) == (name, stage) for run in session.runs())
    return recorded or bool(session.topics(writes[0], name))


def check_run_name(session: Session, stage: str, name: str, writes: Sequence[Channel]) -> str:
    """Return the name that a user gave a run, if the run does not have that stage yet."""
    if _has_stage(session, stage, name, writes):
        raise IpsysError(f"run {name} already has the stage {stage} with other input; use another --run name")
    return name


def newest_run(session: Session, channel: Channel) -> str | None:
    """Return the run whose newest complete stage wrote a channel.

    Imported channels belong to no recorded stage: they count with any complete stage of their run.
    """
    recorded = {output.topic for run in session.runs() for output in run.outputs}
    for run in reversed(complete_runs(session)):
        topics = set(session.topics(channel, run.run))
        if topics and (topics.isdisjoint(recorded) or topics & {output.topic for output in run.outputs}):
            return run.run
    return None


def imported_inputs(session: Session) -> dict[Channel, str]:
    """Return the run of the markers that nodes have sent instead of images, for a stage that passes them on.

    Cameras with images have none in this run: a stage detects their markers. In a log without images, the
    next stages read the run itself.
    """
    for run in reversed(session.runs()) if session.images else ():
        if run.stage == IMPORTED and run.parameters.get("format") == NODE_FORMAT:
            cameras = {camera_of_topic(topic) for topic in session.topics(MARKERS, run.run)}
            if cameras and cameras.isdisjoint(session.images):
                return {MARKERS: run.run}
    return {}


def channel_times(session: Session, topic: str) -> NDArray[np.int64]:
    """Return the log times of the messages of a topic in ns, sorted, shape (N,).

    A derived message has the log time of the message that it was made from. So the times of images are those
    of their markers, if a complete run has read these images, and has a message for each of them. The message
    indexes of images are spread over the whole log, so a log at a URL would need a request for each of them.
    """
    source = _marker_topic(session, topic) if topic in session.images.values() else None
    wanted = source or topic
    readers = [reader for reader in session.readers if wanted in reader.channels]
    return np.sort(np.concatenate([reader.times(wanted) for reader in readers]))


def _marker_topic(session: Session, images: str) -> str | None:
    camera = next(name for name, topic in session.images.items() if topic == images)
    for run in reversed(complete_runs(session)):
        for topic in session.topics(MARKERS, run.run):
            written = any(output.topic == topic for output in run.outputs)
            if written and camera_of_topic(topic) == camera and _has_all_markers(session, run, images, topic):
                return topic
    return None


def _has_all_markers(session: Session, run: Run, images: str, markers: str) -> bool:
    """Return whether a run has read these images as they are now, and has a message for each of them."""
    count = session.count(images)
    hashes = [read.hash for read in run.inputs if (read.topic, read.messages) == (images, count)]
    readers = [reader for reader in session.readers if images in reader.channels]
    is_known = all(reader.has_stored_hash(images) for reader in readers)
    return session.count(markers) == count and is_known and session.hash(images) in hashes
