"""The frames of one node at the centre: their times, the missing ones, and the sessions of the node.

This module has no network and no clock. Frames of JPEG are passed on as they arrive, late ones after newer
ones. A video cannot be decoded in another order, so its packets are passed on in their order: the newer ones
wait at the node.
"""

from collections import deque
from collections.abc import Iterator

from ipsys_log.capture.frames import Frame, NodeRefusedError, SourceError, SourceMessage, mid_exposure_ns
from ipsys_log.capture.node_clock import ClockHistory, Exchange
from ipsys_log.capture.nodes.wire import FrameHeader, FrameRequest, NodeState, StateRequest
from ipsys_log.capture.video_files import is_decodable_start
from ipsys_log.messages import EVENTS_TOPIC, ClockEstimate, Event, RigCamera, clock_topic
from ipsys_log.messages.events import NODE_ANSWERS, NODE_REFUSED
from ipsys_log.units import NS_PER_S

_VIDEO = ("h264", "h265")
_FRAMES_PER_REQUEST = 16
_ESTIMATE_EVERY_NS = NS_PER_S
# A frame that the node has counted for this time, and that has not arrived, is missing.
_ON_THE_WAY_NS = NS_PER_S
# A frame cannot be older on arrival, nor younger: the clock of the node has jumped, and no exchange shows it
# yet.
_OLDEST_NS, _YOUNGEST_NS = 10 * NS_PER_S, -NS_PER_S // 10
# A node was started again if another session answers for this time, and its own session does not.
_RESTARTED_NS = 2 * NS_PER_S
# Before so many answers, the user can still choose between two nodes: the recording does not begin.
_FIRST_ANSWERS = 20
# One gap names at most this number of frames: an hour at 100 frames/s.
_MOST_MISSING = 360_000

Items = Iterator[Frame | SourceMessage]


class NodeStream:
    """The stream of one node.

    Parameters
    ----------
    camera : the camera of the rig at the centre.
    version : the version of ipsys at the centre.
    """

    def __init__(self, camera: RigCamera, version: str) -> None:
        self._camera, self._version = camera, version
        self._session = ""
        self._former: set[str] = set()
        # Another session that answers, and its first request; the sessions that were refused.
        self._rival: tuple[str, int] | None = None
        self._refused: set[str] = set()
        self._began_ns = self._answers = 0
        self._history = ClockHistory()
        self._asked_ns = self._estimated_ns = 0
        self._counts: deque[tuple[int, int]] = deque()
        self._state: NodeState | None = None
        # The next number, None before the first frame; the numbers before it that have not arrived, in order.
        self._first = 0
        self._next: int | None = None
        self._missing: dict[int, None] = {}
        self._gap_count = 0
        self._is_unsure = False

    @property
    def is_known(self) -> bool:
        """Return whether the node has answered."""
        return self._state is not None

    @property
    def has_ended(self) -> bool:
        """Return whether the source of the node has ended and all of its frames have arrived."""
        state = self._state
        return (
            state is not None and state.has_ended and not self._missing and self._expected >= state.recorded
        )

    @property
    def _expected(self) -> int:
        return self._first if self._next is None else self._next

    def report_answer(self, now_ns: int) -> SourceMessage:
        """Return the event for the first answers of the node, with the state of its clock."""
        text = f"camera {self._camera.name}: its node answers; {self._describe_clock()}"
        return self._event(NODE_ANSWERS, text, now_ns)

    def _describe_clock(self) -> str:
        line = self._history.line
        if line is None:
            return "its clock is not known yet"
        offset_s = line.offset_ns / NS_PER_S
        return (
            f"its clock is {abs(offset_s):.6f} s {'behind' if offset_s >= 0 else 'ahead of'} this machine's"
        )

    def state_request(self) -> StateRequest:
        """Return the next request for the state of the node."""
        return StateRequest(self._version, self._session, next(iter(self._missing), self._expected))

    def frame_request(self) -> FrameRequest | None:
        """Return a request for missing frames; None if there are none."""
        if not self._missing or self._is_unsure:
            return None
        first = count = 0
        for number in self._missing:
            if count and number != first + count:
                break
            first, count = (first, count + 1) if count else (number, 1)
            if count == _FRAMES_PER_REQUEST:
                break
        return FrameRequest(self._session, first, first + count)

    def take_state(self, state: NodeState, sent_ns: int, back_ns: int) -> Items:
        """Take the answer of a node to a request; yield messages about it.

        Parameters
        ----------
        sent_ns, back_ns : when the request was sent and the answer arrived, by the clock of the centre.

        Raises
        ------
        SourceError
            The node has another version of ipsys, or two nodes send as this camera from the start.
        NodeRefusedError
            The node was started again, and has another version of ipsys now.
        """
        if not self._session:
            self._check_first_version(state)
        if second := self._find_second(state, sent_ns):
            yield from self._refuse(second, back_ns)
            if second == state.session:
                return
        if state.session != self._session:
            if self._rival is not None and sent_ns - self._rival[1] < _RESTARTED_NS:
                return
            self._check_next_version(state)
            self._began_ns = sent_ns
            yield from self._begin(state, back_ns)
        self._state, self._asked_ns, self._is_unsure = state, max(sent_ns, self._asked_ns), False
        self._answers += 1
        exchange = Exchange(sent_ns, state.received_ns, state.replied_ns, back_ns)
        jump_ns = self._history.add(exchange) if _is_possible(exchange) else None
        if jump_ns is not None:
            yield self._event(
                "clock_jumped",
                f"camera {self._camera.name}: the clock of its node jumped by {jump_ns / NS_PER_S:+.3f} s; "
                "the times of its frames are converted with the new offset",
                back_ns,
            )
        if back_ns - self._estimated_ns >= _ESTIMATE_EVERY_NS or jump_ns is not None:
            self._estimated_ns = back_ns
            yield from self._estimate(back_ns)
        yield from self._find_tail(state.recorded, back_ns)

    def take_frame(self, header: FrameHeader, data: bytes, now_ns: int, is_late: bool) -> Items:
        """Take a frame; yield it if it is new and its turn has come, and messages about gaps.

        Parameters
        ----------
        now_ns : its arrival.
        is_late : it was asked for.
        """
        number = header.number
        if header.session != self._session or not (number in self._missing or number >= self._expected):
            return
        frame = self._frame(header, data, now_ns)
        # A recording that begins in the middle of a video begins with a keyframe.
        if self._next is None and self._first > 0 and not is_decodable_start(frame):
            self._first = number + 1
            return
        is_certain = is_late or self._is_plausible(frame, now_ns)
        if number >= self._expected:
            yield from self._find_gap(number, now_ns)
            self._next = number + 1
            if not is_certain or (header.format in _VIDEO and self._missing):
                self._is_unsure = self._is_unsure or not is_certain
                self._missing[number] = None
                self._gap_count += 1
                return
        elif not is_certain or (header.format in _VIDEO and number != next(iter(self._missing))):
            return
        was_missing = number in self._missing
        self._missing.pop(number, None)
        yield frame
        if was_missing and not self._missing:
            yield from self._close_gap(now_ns)

    def lose(self, header: FrameHeader, now_ns: int) -> Items:
        """Take the answer of a node that it does not have a frame any more."""
        if header.session != self._session or header.number not in self._missing:
            return
        del self._missing[header.number]
        yield self._event(
            "node_frames_lost",
            f"camera {self._camera.name}: frame {header.number} is lost, because its node cannot read it; the"
            " disk of the node is full or has failed",
            now_ns,
        )
        if not self._missing:
            yield from self._close_gap(now_ns)

    def _check_first_version(self, state: NodeState) -> None:
        if state.version != self._version:
            raise SourceError(
                f"camera {self._camera.name}: its node has ipsys {state.version}, but this machine has ipsys "
                f"{self._version}; install one version on both"
            )

    def _check_next_version(self, state: NodeState) -> None:
        if state.version != self._version:
            name, own = self._camera.name, self._version
            raise NodeRefusedError(
                f"camera {name}: its node has ipsys {state.version} now, but this machine has ipsys {own}, "
                f"so its frames are not recorded; install ipsys {own} on its host, and start the node again"
            )

    def _find_second(self, state: NodeState, sent_ns: int) -> str:
        """Return the session of a second node, known by an answer of each to one request; "" for none."""
        rival, self._rival = self._rival, None
        if state.session == self._session:
            return rival[0] if rival is not None and sent_ns >= rival[1] else ""
        if not self._session or (state.session in self._former and sent_ns < self._began_ns):
            return ""
        if state.session in self._former or sent_ns <= self._asked_ns:
            return state.session
        self._rival = rival if rival is not None and rival[0] == state.session else (state.session, sent_ns)
        return ""

    def _refuse(self, session: str, now_ns: int) -> Items:
        """Refuse a second node: once by an event, or by an error at the start.

        Raises
        ------
        SourceError
            The recording has not begun.
        """
        name = self._camera.name
        advice = "end one of them, or give it another --camera"
        if self._answers < _FIRST_ANSWERS:
            raise SourceError(f"camera {name}: two nodes send as camera {name}; {advice}")
        if session not in self._refused:
            self._refused.add(session)
            text = f"camera {name}: two nodes send as camera {name}, and the second one is refused; {advice}"
            yield self._event(NODE_REFUSED, text, now_ns)

    def _begin(self, state: NodeState, now_ns: int) -> Items:
        """Begin a session: of the first one, only new frames; of a later one, all."""
        if self._session:
            self._former.add(self._session)
            text = f"camera {self._camera.name}: its node was started again"
            if self._missing:
                text += f"; {len(self._missing)} frames before are only in the log of the node"
            yield self._event("node_restarted", text, now_ns)
        self._first = 0 if self._session else state.recorded
        self._session, self._next = state.session, None
        self._history, self._counts, self._rival = ClockHistory(), deque(), None
        self._missing, self._gap_count = {}, 0

    def _frame(self, header: FrameHeader, data: bytes, now_ns: int) -> Frame:
        time_ns = self._history.to_centre_ns(header.time_ns)
        if time_ns is not None:
            # The node has given the middle of the exposure. The reader of the camera adds this distance
            # again.
            time_ns -= mid_exposure_ns(0, self._camera)
        return Frame(
            data, header.format, time_ns, received_ns=now_ns, session=header.session, number=header.number
        )

    def _is_plausible(self, frame: Frame, now_ns: int) -> bool:
        return frame.time_ns is not None and _YOUNGEST_NS <= now_ns - frame.time_ns <= _OLDEST_NS

    def _find_tail(self, count: int, now_ns: int) -> Items:
        """Find frames that the node has counted long ago, and that have not arrived."""
        self._counts.append((now_ns, count))
        while now_ns - self._counts[0][0] >= _ON_THE_WAY_NS:
            counted = self._counts.popleft()[1]
            if counted > self._expected and (self._next is not None or self._first == 0):
                yield from self._find_gap(counted, now_ns)
                self._next = counted

    def _find_gap(self, number: int, now_ns: int) -> Items:
        """Note the frames before a number as missing."""
        first = max(self._expected, number - _MOST_MISSING)
        if number <= first:
            return
        is_new = not self._missing
        self._missing.update(dict.fromkeys(range(first, number)))
        self._gap_count = len(self._missing) if is_new else self._gap_count + number - first
        yield self._event(
            "node_gap",
            f"camera {self._camera.name}: frames {first} to {number - 1} of its node are missing; the node "
            "sends them again",
            now_ns,
        )

    def _close_gap(self, now_ns: int) -> Items:
        yield self._event(
            "node_gap_filled",
            f"camera {self._camera.name}: all frames of its node have arrived, {self._gap_count} late",
            now_ns,
        )
        self._gap_count = 0

    def _estimate(self, now_ns: int) -> Items:
        line = self._history.line
        if line is not None:
            name, session = self._camera.name, self._session
            payload = ClockEstimate(
                now_ns, name, session, line.node_ns, line.offset_ns, line.drift, line.bound_ns, line.exchanges
            )
            yield SourceMessage(clock_topic(name), payload)

    def _event(self, kind: str, text: str, now_ns: int) -> SourceMessage:
        return SourceMessage(EVENTS_TOPIC, Event(now_ns, kind, text, self._camera.name))


def _is_possible(exchange: Exchange) -> bool:
    """Return whether the times of an exchange are in order."""
    return exchange.replied_ns >= exchange.received_ns and exchange.round_trip_ns >= 0
