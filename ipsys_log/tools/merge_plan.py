"""Plan of a merge: the channels that come with each log, one rig of all, after a check for contradictions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import MergeSource, check_same_parameters, check_shift, find_new_ids
from ipsys_log.messages import Rig
from ipsys_log.messages.channels import CUTS, MEASUREMENTS, MERGES, RECORD, RIG, RUN_EVENTS
from ipsys_log.plain_text import shell_words
from ipsys_log.vision.lenses import same_intrinsics


class LogOffset(NamedTuple):
    """The offset of a log in ns, and the standard deviation of an estimate in s; None if it was given."""

    offset_ns: int = 0
    sigma_s: float | None = None


@dataclass(slots=True)
class _Common:
    """The common content of logs: by topic its owner's topic, and the combined rig of the owner."""

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
    equal : for each log, the topics whose messages come with an earlier log, with their topics there.
    changed : the topics of the merged log whose content is that of no log: the combined rig.
    """

    sources: Sequence[MergeSource]
    offsets: Sequence[LogOffset]
    equal: Sequence[Mapping[str, str]]
    changed: frozenset[str] = field(default_factory=frozenset)


def check_logs_differ(sessions: Sequence[Session]) -> None:
    """Refuse logs with images or results of the same camera, or with measurements of the same id."""
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

    Equal settings, and channels with the same messages, come with the first log that has them. The rigs are
    combined. The results of a run of the same name for other cameras join it.

    Raises
    ------
    IpsysError
        Settings contradict each other, two logs have different results of one run, or times within a log
        cannot be shifted.
    """
    common = _Common([{} for _ in sessions])
    _plan_rig(sessions, common)
    _plan_intrinsics(sessions, common)
    check_same_parameters((session.paths[0], session.runs()) for session in sessions)
    _plan_same_channels(sessions, common)
    sources = [
        _source(session, number, offset.offset_ns, common)
        for number, (session, offset) in enumerate(zip(sessions, offsets, strict=True))
    ]
    changed = frozenset(common.rig_topics[1] if common.rig is not None else ())
    return MergePlan(sources, offsets, common.equal, changed)


def _source(session: Session, number: int, offset_ns: int, common: _Common) -> MergeSource:
    (reader,) = session.readers
    equal = common.equal[number]
    topics = [topic for topic, one in reader.channels.items() if one.message_count and topic not in equal]
    if offset_ns:
        for topic in topics:
            try:
                check_shift(reader.channels[topic])
            except IpsysError as error:
                raise IpsysError(f"{session}: {error}") from None
    replaced = {}
    if common.rig is not None and common.rig_topics[0] == number:
        replaced = dict.fromkeys(common.rig_topics[1], encode(common.rig))
    metadata = {"merged_from": reader.path.name, "offset_ns": str(offset_ns)} if number else {}
    return MergeSource(reader, offset_ns, topics, replaced, metadata)


def _plan_rig(sessions: Sequence[Session], common: _Common) -> None:
    """Note the combined rig if it is not that of its owner, and the equal topics of later logs."""
    topics = [session.topics(RIG) for session in sessions]
    with_rig = [number for number, names in enumerate(topics) if names]
    if len(with_rig) < 2:
        return
    owner = with_rig[0]
    own = combined = _only_rig(sessions[owner], topics[owner])
    for number in with_rig[1:]:
        rig = _only_rig(sessions[number], topics[number])
        combined = combine_rigs(combined, rig, (str(sessions[owner]), str(sessions[number])))
        common.equal[number] |= dict.fromkeys(topics[number], topics[owner][0])
    common.rig_topics = owner, topics[owner]
    common.rig = None if combined == own else combined


def _only_rig(session: Session, topics: Sequence[str]) -> Rig:
    rigs: list[Rig] = session.payloads(topics)
    if any(rig != rigs[0] for rig in rigs):
        raise IpsysError(
            f"{session}: its rig changes during the log; cut the log into parts with one rig each: ipsys cut"
        )
    return rigs[0]


def _plan_intrinsics(sessions: Sequence[Session], common: _Common) -> None:
    """Note the equal intrinsics of later logs."""
    owners: dict[str, Session] = {}
    for session, equal in zip(sessions, common.equal, strict=True):
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


def _plan_same_channels(sessions: Sequence[Session], common: _Common) -> None:
    """Note the channels of later logs whose messages are those of an earlier log."""
    owners: dict[str, Session] = {}
    for session, equal in zip(sessions, common.equal, strict=True):
        for topic in sorted(session.readers[0].channels.keys() - {*equal, CUTS.topic, MERGES.topic}):
            if not session.count(topic):
                continue
            owner, run = owners.setdefault(topic, session), run_of_topic(topic)
            if owner is session:
                continue
            if session.count(topic) == owner.count(topic) and session.hash(topic) == owner.hash(topic):
                equal[topic] = topic
            elif run is not None and topic not in (RECORD.topic_of(run), RUN_EVENTS.topic_of(run)):
                raise IpsysError(
                    f"{owner} and {session} have different results of run {run}: {topic}; leave the run of "
                    f"one log out: ipsys cut {shell_words(*session.paths)} -o part.mcap --exclude-runs {run}"
                )


# These fields describe the computer of a recorder, and not the lab: those of the first rig count.
_OF_COMPUTER = frozenset(("source", "calibration", "stream"))
# Entries with one of these names and the same value there describe the same thing.
_KEYS = ("id", "name")


def combine_rigs(one: Rig, other: Rig, where: tuple[str, str]) -> Rig:
    """Return the rig with the cameras, markers and reference points of two rigs of one lab.

    A value that only one rig has counts. The sources of cameras, their calibration files, and the streams are
    those of the first rig.

    Parameters
    ----------
    where : the names of the logs, for the error.

    Raises
    ------
    IpsysError
        The rigs contradict each other; the text names the first field that differs.

    Examples
    --------
    >>> from ipsys_log.messages import RigMarker
    >>> rigs = [Rig("lab", "DICT_4X4_50", 0.1, (RigMarker(number),)) for number in (1, 2)]
    >>> [marker.id for marker in combine_rigs(*rigs, ("a.mcap", "b.mcap")).markers]
    [1, 2]
    """
    combined: Rig = _combine(one, other, where, "the rig")
    return combined


def _combine(one: Any, other: Any, where: tuple[str, str], place: str) -> Any:
    values = {
        field.name: _combine_value(
            field.name, getattr(one, field.name), getattr(other, field.name), where, place
        )
        for field in fields(one)
    }
    return type(one)(**values)


def _combine_value(name: str, one: Any, other: Any, where: tuple[str, str], place: str) -> Any:
    if one is None or other is None:
        return other if one is None else one
    if one == other or name in _OF_COMPUTER:
        return one
    if is_dataclass(one):
        return _combine(one, other, where, f"{name} of {place}")
    if isinstance(one, tuple):
        return _combine_entries(name, one, other, where)
    raise IpsysError(
        f"{where[0]} and {where[1]} contradict each other: {name} of {place} is {one!r} and {other!r}; "
        f"correct one rig, or leave it out: "
        f"ipsys cut {shell_words(where[1])} -o part.mcap --exclude-topics /rig"
    )


def _combine_entries(name: str, one: tuple[Any, ...], other: tuple[Any, ...], where: tuple[str, str]) -> Any:
    entries = {_key(entry): entry for entry in one}
    for entry in other:
        key = _key(entry)
        place = f"{name.removesuffix('s').replace('_', ' ')} {key}"
        entries[key] = _combine(entries[key], entry, where, place) if key in entries else entry
    return tuple(entries.values())


def _key(entry: Any) -> Any:
    return next(getattr(entry, name) for name in _KEYS if hasattr(entry, name))
