"""The result of a survey: which parts of a log are whole, which are damaged, and which messages are gone."""

from dataclasses import dataclass, field

from ipsys_log.log.byte_source import View
from ipsys_log.log.chunks import Inside
from ipsys_log.log.contents import Contents
from ipsys_log.log.damage.definitions import Definitions
from ipsys_log.log.damage.regions import Stretch
from ipsys_log.log.damage.resync import Resync
from ipsys_log.log.damage.salvage import Salvage
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import RecordAt

__all__ = ["Indexed", "Lost", "Survey"]


@dataclass(slots=True)
class Lost:
    """Messages that are known to be gone, by topic: their log times in ns.

    `uncounted` is the number of stretches with an unknown number of messages, `bytes` the number of
    unreadable bytes.
    """

    times_ns: dict[str, list[int]] = field(default_factory=dict)
    uncounted: int = 0
    bytes: int = 0

    def note(self, topic: str, time_ns: int) -> None:
        self.times_ns.setdefault(topic, []).append(time_ns)


@dataclass(slots=True)
class Indexed:
    """The message indexes that follow a chunk (`inside`), or a damaged stretch that may have been one."""

    start: int
    inside: Inside | None = None
    stretch: Stretch | None = None
    rows: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    offsets: dict[int, int] = field(default_factory=dict)
    sound: bool = True

    @property
    def is_complete(self) -> bool:
        return self.inside is not None and self.sound and self.rows.keys() >= self.inside.entries.keys()


@dataclass(slots=True)
class Survey:
    """The whole records up to `end`, except the stretches in `damaged`.

    `cut` is the unreadable end of a log without DataEnd; `finished` says that this record lies at `end`.
    `saved` takes the readable messages of damaged chunks. `faults` lists the faults in words.
    `unindexed` holds the entries of the last chunk if its message indexes are missing or cut off.
    """

    view: View
    resync: Resync
    definitions: Definitions
    saved: Salvage | None = None
    contents: Contents = field(default_factory=Contents)
    loose: Inside = field(default_factory=Inside)
    counts: dict[int, dict[int, int]] = field(default_factory=dict)
    hashes: dict[str, ChannelHash] = field(default_factory=dict)
    damaged: list[Stretch] = field(default_factory=list)
    homeless: list[RecordAt] = field(default_factory=list)  # messages that cannot stay at their offset
    wrong_heads: list[tuple[int, bytes]] = field(default_factory=list)  # what chunks say of their times
    cut: Stretch | None = None
    lost: Lost = field(default_factory=Lost)
    faults: list[str] = field(default_factory=list)
    unindexed: Inside | None = None
    end: int = 0
    crc: int = 0
    crc_is_right: bool = True
    has_crc: bool = False  # of the data section
    finished: bool = False
    crc_at: int = 0
    wrong_length: int = -1  # a record with an impossible length
    has_crcs: bool = False  # of the chunks so far
    doubtful_to: int = 0  # after damage, unconfirmed lengths are checked closely
    indexed: Indexed | None = None
