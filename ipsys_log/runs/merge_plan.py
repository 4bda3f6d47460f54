"""Plan of a merge: the channels that come with each log, after a check for contradictions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import same_intrinsics
from ipsys_log.log.codec import decode, encode, schema_name
from ipsys_log.log.combined_logs import find_new_ids
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import MergeSource
from ipsys_log.log.shifted_times import check_shift
from ipsys_log.messages import Cut, FrameTransforms, Merge, Rig, Run
from ipsys_log.messages.channels import CUTS, MEASUREMENTS, MERGES, POSES, RECORD, RIG
from ipsys_log.plain_text import shell_words
from ipsys_log.rig.combination import combine_rigs
from ipsys_log.runs.origins import own_inputs
from ipsys_log.runs.renaming import rename_channels, rename_frames, rename_record, rename_topic


class LogOffset(NamedTuple):
    """The offset of a log in ns, and the standard deviation of an estimate in s; None if it was given."""

    offset_ns: int = 0
    sigma_s: float | None = None


@dataclass(slots=True)
class _Settings:
    """The settings that the logs share: by topic, their owner's topic; and the combined rig of the owner."""

    equal: list[dict[str, str]]
    rig: Rig | None = None
    rig_topics: tuple[int, Sequence[str]] = (0, ())


@dataclass(frozen=True, slots=True)
class MergePlan:
    """The plan of a merge.

    Attributes
    ----------
    sources : the logs, in the order of the command.
    offsets : their offsets.
    renamed_runs : for each log, the new names of its runs by their old names.
    equal : for each log, the topics of equal settings that an earlier log has, with their topics there.
    changed : the topics of the merged log whose content is that of no log: the combined rig.
    """

    sources: Sequence[MergeSource]
    offsets: Sequence[LogOffset]
    renamed_runs: Sequence[Mapping[str, str]]
    equal: Sequence[Mapping[str, str]]
    changed: frozenset[str] = field(default_factory=frozenset)


def check_logs_differ(sessions: Sequence[Session]) -> None:
    """Refuse logs with images or results of the same camera, or with measurements of the same id.

    Raises
    ------
    IpsysError
        The text names the camera, or the id, and both logs.
    """
    owners: dict[str, Session] = {}
    for session in sessions:
        for camera in sorted(_cameras(session)):
            other = owners.setdefault(camera, session)
            if other is not session:
                raise IpsysError(
                    f"two cameras have the same name: {camera} is in {other} and in {session}; parts of one "
                    f"recording need no merge: "
                    f"ipsys replay {shell_words(*other.paths)} {shell_words(*session.paths)}"
                )
    new_ids = find_new_ids(session.payloads(session.topics(MEASUREMENTS)) for session in sessions)
    for session, ids in zip(sessions, new_ids, strict=True):
        for name in ids:
            raise IpsysError(
                f"{session}: an earlier log has a measurement with the id {name}, too; leave those of "
                f"one log out: "
                f"ipsys cut {shell_words(*session.paths)} -o part.mcap --exclude-topics /measurements"
            )


def _cameras(session: Session) -> set[str]:
    """Return the cameras with images, or with results in a run."""
    topics = [topic for reader in session.readers for topic in reader.channels if session.count(topic)]
    derived = {camera_of_topic(topic) for topic in topics if run_of_topic(topic)}
    return {*session.images, *(camera for camera in derived if camera)}


def plan_merge(sessions: Sequence[Session], offsets: Sequence[LogOffset]) -> MergePlan:
    """Plan the merge of logs, each in its own session, whose cameras differ.

    Equal settings come with the first log that has them. The rigs are combined. A run whose name an earlier
    log has gets a new name.

    Raises
    ------
    IpsysError
        Settings contradict each other, or times within a log cannot be shifted.
    """
    settings = _Settings([{} for _ in sessions])
    _plan_rig(sessions, settings)
    _plan_intrinsics(sessions, settings)
    renamed_runs = _new_run_names(sessions)
    sources = [
        _source(session, number, offset.offset_ns, settings, renamed_runs[number])
        for number, (session, offset) in enumerate(zip(sessions, offsets, strict=True))
    ]
    changed = frozenset(settings.rig_topics[1] if settings.rig is not None else ())
    return MergePlan(sources, offsets, renamed_runs, settings.equal, changed)


def _source(
    session: Session, number: int, offset_ns: int, settings: _Settings, names: Mapping[str, str]
) -> MergeSource:
    (reader,) = session.readers
    topics = {
        topic: rename_topic(topic, names)
        for topic, channel in reader.channels.items()
        if channel.message_count and topic not in settings.equal[number]
    }
    if offset_ns:
        for topic in topics:
            try:
                check_shift(reader.channels[topic])
            except IpsysError as error:
                raise IpsysError(f"{session}: {error}") from None
    changes = _name_changes(session, names) if names else {}
    if settings.rig is not None and settings.rig_topics[0] == number:
        rig_data = encode(settings.rig)
        changes |= dict.fromkeys(settings.rig_topics[1], lambda _: rig_data)
    metadata = {"merged_from": reader.path.name, "offset_ns": str(offset_ns)} if number else {}
    return MergeSource(reader, offset_ns, topics, changes, metadata)


def _plan_rig(sessions: Sequence[Session], settings: _Settings) -> None:
    """Note the combined rig if it is not that of its owner, and the equal topics of later logs.

    Raises
    ------
    IpsysError
        The rigs contradict each other, or a rig changes during its log.
    """
    topics = [session.topics(RIG) for session in sessions]
    with_rig = [number for number, names in enumerate(topics) if names]
    if len(with_rig) < 2:
        return
    owner = with_rig[0]
    own = combined = _only_rig(sessions[owner], topics[owner])
    for number in with_rig[1:]:
        rig = _only_rig(sessions[number], topics[number])
        combined = combine_rigs(combined, rig, (str(sessions[owner]), str(sessions[number])))
        settings.equal[number] |= dict.fromkeys(topics[number], topics[owner][0])
    settings.rig_topics = owner, topics[owner]
    settings.rig = None if combined == own else combined


def _only_rig(session: Session, topics: Sequence[str]) -> Rig:
    rigs: list[Rig] = session.payloads(topics)
    if any(rig != rigs[0] for rig in rigs):
        raise IpsysError(
            f"{session}: its rig changes during the log; cut the log into parts with one rig each: ipsys cut"
        )
    return rigs[0]


def _plan_intrinsics(sessions: Sequence[Session], settings: _Settings) -> None:
    """Note the equal intrinsics of later logs.

    Raises
    ------
    IpsysError
        Two logs have different intrinsics of one camera.
    """
    owners: dict[str, Session] = {}
    for session, equal in zip(sessions, settings.equal, strict=True):
        for camera, topic in session.calibrations.items():
            owner = owners.setdefault(camera, session)
            if owner is session:
                continue
            first = owner.payloads([owner.calibrations[camera]])
            if not all(same_intrinsics(lens, first[0]) for lens in (*first, *session.payloads([topic]))):
                raise IpsysError(
                    f"{owner} and {session} contradict each other: the intrinsics of camera {camera} differ; "
                    f"leave one out: ipsys cut {shell_words(*session.paths)} -o part.mcap "
                    f"--exclude-topics {shell_words(topic)}"
                )
            equal[topic] = owner.calibrations[camera]


def _new_run_names(sessions: Sequence[Session]) -> list[dict[str, str]]:
    """Return for each log the new names of its runs whose names an earlier log has, by their old names."""
    taken: set[str] = set()
    renamed = []
    for session in sessions:
        names = session.run_names()
        new: dict[str, str] = {}
        for name in sorted(names & taken):
            numbered = (f"{name}_{number}" for number in count(2))
            new[name] = next(one for one in numbered if one not in taken | names | {*new.values()})
        taken |= {new.get(name, name) for name in names}
        renamed.append(new)
    return renamed


def _name_changes(session: Session, names: Mapping[str, str]) -> dict[str, Callable[[bytes], bytes]]:
    """Return the changes of the messages that contain names of runs, by topic."""

    def change_record(data: bytes) -> bytes:
        run: Run = decode(schema_name(Run), data)
        return encode(rename_record(run, names, own_inputs(session, run).keys()))

    def change_frames(data: bytes) -> bytes:
        return encode(rename_frames(decode(schema_name(FrameTransforms), data), names))

    def change_cut(data: bytes) -> bytes:
        return encode(rename_channels(decode(schema_name(Cut), data), names))

    def change_merge(data: bytes) -> bytes:
        record: Merge = decode(schema_name(Merge), data)
        logs = tuple(rename_channels(log, names) for log in record.logs)
        return encode(replace(record, logs=logs))

    runs = sorted(session.run_names())
    records = [topic for run in runs for topic in session.topics(RECORD, run)]
    poses = [topic for run in names for topic in session.topics(POSES, run)]
    return {
        **dict.fromkeys(records, change_record),
        **dict.fromkeys(poses, change_frames),
        CUTS.topic: change_cut,
        MERGES.topic: change_merge,
    }
