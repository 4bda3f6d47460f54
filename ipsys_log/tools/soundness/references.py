"""References between the messages of a log, and their times: order, stamps, outliers, clocks of nodes."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace

from ipsys_log.engine.checks import image_sizes
from ipsys_log.engine.graph import writes
from ipsys_log.engine.provenance import complete_runs
from ipsys_log.engine.states import is_fitted_here
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Measurement, Rig, channels
from ipsys_log.messages.rig_file import check_rig
from ipsys_log.models.table import is_known, reads_corners
from ipsys_log.plain_text import join_names
from ipsys_log.tools.soundness.finding import REMARK, LogFinding
from ipsys_log.units import NS_PER_S, format_time
from ipsys_log.vision.lenses import calibration_remarks, check_calibration


def check_rigs(session: Session) -> Iterator[LogFinding]:
    """Check that a log with images, markers or measurements has a valid rig."""
    topics = session.topics(channels.RIG)
    if not topics:
        if session.images or session.topics(channels.MEASUREMENTS) or _marker_cameras(session):
            advice = "give one to each command: --rig lab.toml"
            yield LogFinding("reference", REMARK, "the log has no rig", advice, channels.RIG_TOPIC)
        return
    for message in session.messages(topics):
        try:
            check_rig(message.payload, "the rig")
        except IpsysError as error:
            advice = "give a correct rig to each command: --rig lab.toml"
            yield LogFinding("reference", REMARK, str(error), advice, message.topic, message.log_time_ns, 1)


def _marker_cameras(session: Session) -> dict[str, str]:
    """Return the cameras with markers in a run, each with one topic of its markers."""
    topics = [topic for run in sorted(session.run_names()) for topic in session.topics(channels.MARKERS, run)]
    return {str(camera_of_topic(topic)): topic for topic in topics}


def _cameras(session: Session) -> dict[str, str]:
    """Return the cameras with images or markers, each with its topic."""
    return _marker_cameras(session) | session.images


def check_cameras(session: Session) -> Iterator[LogFinding]:
    """Check that the rig has each camera with images or markers."""
    rigs: list[Rig] = session.payloads(session.topics(channels.RIG))
    known = {camera.name for rig in rigs for camera in rig.cameras}
    if not known:  # a rig may leave out the cameras
        return
    for camera, topic in sorted(_cameras(session).items()):
        if camera not in known:
            text = f"camera {camera} is not in the rig, which has {join_names(sorted(known))}"
            yield LogFinding("reference", REMARK, text, "add it to lab.toml as [[cameras]]", topic)


def check_intrinsics(session: Session) -> Iterator[LogFinding]:
    """Check that each camera has valid intrinsics for the size of its images."""
    sizes_px = image_sizes(session)
    for camera, topic in sorted(_cameras(session).items()):
        advice = f"calibrate it, and give its intrinsics: --calibration {camera}=FILE"
        if camera not in session.calibrations:
            text = f"camera {camera} has no intrinsics"
            yield LogFinding("reference", REMARK, text, advice, topic)
            continue
        stored = session.calibrations[camera]
        message = next(session.messages([stored]))
        lens = message.payload
        place = stored, message.log_time_ns
        try:
            check_calibration(replace(lens, frame_id=camera), "the intrinsics")
            unusual = calibration_remarks(lens)
        except IpsysError as error:
            unusual = [str(error)]
        for text in unusual:
            yield LogFinding("reference", REMARK, f"camera {camera}: {text}", advice, *place)
        if camera in sizes_px and sizes_px[camera] != (lens.width, lens.height):
            width, height = sizes_px[camera]
            text = (
                f"the intrinsics of camera {camera} are for {lens.width} x {lens.height} px, but its images "
                f"have {width} x {height} px"
            )
            yield LogFinding("reference", REMARK, text, advice, *place)


def check_measurements(session: Session) -> Iterator[LogFinding]:
    """Check that measurements name markers and reference points of the rig, and withdrawals measurements."""
    rigs: list[Rig] = session.payloads(session.topics(channels.RIG))[:1]
    active: set[str] = set()
    withdrawn: set[str] = set()
    faults: dict[tuple[str, str], list[tuple[str, int]]] = {}
    for message in session.messages([*session.topics(channels.RIG), *session.topics(channels.MEASUREMENTS)]):
        payload = message.payload
        if isinstance(payload, Rig):
            rigs[:] = [payload]
        elif isinstance(payload, Measurement):
            for fault in _faults(payload, active, withdrawn, rigs[0] if rigs else None):
                faults.setdefault(fault, []).append((payload.id, message.log_time_ns))
            _follow(payload, active, withdrawn)
    for (text, advice), places in faults.items():
        ids = join_names([name for name, _ in places])
        title = "measurement" if len(places) == 1 else "measurements"
        place = channels.MEASUREMENTS_TOPIC, places[0][1], len(places)
        yield LogFinding("reference", REMARK, f"{title} {ids}: {text}", advice, *place)


def _follow(measurement: Measurement, active: set[str], withdrawn: set[str]) -> None:
    """Move the id of a message about a measurement to the valid or to the withdrawn ids."""
    if measurement.refers_to is None:
        active.add(measurement.id)
    elif measurement.withdraws is not None and measurement.withdraws in active:
        active.remove(measurement.withdraws)
        withdrawn.add(measurement.withdraws)
    elif measurement.readmits in withdrawn:
        withdrawn.remove(measurement.readmits)
        active.add(measurement.readmits)


def _faults(
    measurement: Measurement, active: set[str], withdrawn: set[str], rig: Rig | None
) -> Iterator[tuple[str, str]]:
    """Yield the wrong references of a measurement, each with the advice."""
    again = "withdraw it and measure again: ipsys measure"
    complete = "add it to lab.toml, and give --rig lab.toml"
    no_effect = "it has no effect: check the id"
    if measurement.withdraws is not None:
        if measurement.withdraws not in active:
            yield f"withdraws {measurement.withdraws}, which is not in the log", no_effect
        return
    if measurement.readmits is not None:
        if measurement.readmits not in withdrawn:
            yield f"re-admits {measurement.readmits}, which is not withdrawn", no_effect
        return
    if measurement.id in active:
        yield "an earlier measurement has the same id", "withdraw one of them"
    if measurement.from_reference is None and measurement.marker_id is None:
        yield "has no marker", again
        return
    if rig is None:
        return
    if measurement.marker_id is not None and not rig.knows(measurement.marker_id):
        yield f"marker {measurement.marker_id} is not in the rig", complete
    points = {point.name for point in rig.reference_points}
    for name in sorted({distance.reference for distance in measurement.distances} - points):
        yield f"reference point {name} is not in the rig", complete


_DAY_NS = 86_400 * NS_PER_S
# Messages so many days before or after all others are far from the rest, if they are less than a tenth.
_FAR_DAYS = 30
_FAR_SHARE = 0.1
_ADVICE = "write the latency of the camera into latency_ns, or use a network with equal delays both ways"


@dataclass(slots=True)
class _Occurrences:
    """The number of messages with a fault, and the log time of the first one."""

    count: int = 0
    first_ns: int = 0

    def add(self, time_ns: int) -> None:
        if not self.count:
            self.first_ns = time_ns
        self.count += 1


@dataclass(slots=True)
class MessageTimes:
    """The times of messages in the order of the file; the memory does not grow with their number.

    ``stamped`` are the topics of images whose publish times are the stamps of a camera.
    """

    stamped: Collection[str]
    _last: dict[str, tuple[int, int]] = field(default_factory=dict)
    _decreasing: dict[str, _Occurrences] = field(default_factory=dict)
    _repeated: dict[str, _Occurrences] = field(default_factory=dict)
    _distant: dict[str, _Occurrences] = field(default_factory=dict)
    _days: dict[int, dict[str, _Occurrences]] = field(default_factory=dict)

    def add(self, topic: str, log_time_ns: int, publish_time_ns: int) -> None:
        """Add the times of the next message in the file."""
        self._days.setdefault(log_time_ns // _DAY_NS, {}).setdefault(topic, _Occurrences()).add(log_time_ns)
        is_stamped = topic in self.stamped
        if topic in self._last:
            last_log_ns, last_stamp_ns = self._last[topic]
            if log_time_ns < last_log_ns:
                self._decreasing.setdefault(topic, _Occurrences()).add(log_time_ns)
            elif is_stamped and publish_time_ns <= last_stamp_ns:
                self._repeated.setdefault(topic, _Occurrences()).add(log_time_ns)
        if is_stamped and abs(publish_time_ns - log_time_ns) > _DAY_NS:
            self._distant.setdefault(topic, _Occurrences()).add(log_time_ns)
        self._last[topic] = log_time_ns, publish_time_ns

    def findings(self) -> Iterator[LogFinding]:
        """Yield the findings, by topic."""
        for tallies, text, advice in (
            (
                self._decreasing,
                "log times decrease",
                "ipsys reads the messages in the order of their times; correct the recorder",
            ),
            (
                self._repeated,
                "capture times do not increase",
                "positions at these times are not reliable; check the clock of the camera",
            ),
            (
                self._distant,
                "capture times are more than a day from the log times",
                "set the clock of the camera, and record again",
            ),
        ):
            for topic, tally in sorted(tallies.items()):
                yield LogFinding("time", REMARK, text, advice, topic, tally.first_ns, tally.count)
        yield from self._far()

    def _far(self) -> Iterator[LogFinding]:
        """Yield a finding for each topic with few messages far from the time of all others."""
        groups: list[list[int]] = []
        for day in sorted(self._days):
            if groups and day - groups[-1][-1] <= _FAR_DAYS:
                groups[-1].append(day)
            else:
                groups.append([day])
        sizes = [sum(t.count for day in group for t in self._days[day].values()) for group in groups]
        main_ns = groups[sizes.index(max(sizes))][0] * _DAY_NS if groups else 0
        for group, size in zip(groups, sizes, strict=True):
            for day in group if size < _FAR_SHARE * sum(sizes) else ():
                for topic, tally in sorted(self._days[day].items()):
                    text = f"log times are far from those of the log ({format_time(main_ns)[:10]})"
                    advice = "the clock of its writer was wrong: leave these messages out"
                    yield LogFinding("time", REMARK, text, advice, topic, tally.first_ns, tally.count)


def check_clocks(session: Session) -> Iterator[LogFinding]:
    """Check the clock estimates of nodes against the newest joint model that was fitted to this log."""
    topics = session.topics(channels.CLOCKS)
    fitted = [run for run in complete_runs(session) if writes(run, channels.MODEL) and is_fitted_here(run)]
    models = (
        [session.payloads(session.topics(channels.MODEL, run.run))[-1] for run in fitted] if topics else []
    )
    joint = [model for model in models if is_known(model.name) and reads_corners(model.name)]
    if not joint:
        return
    # Late: it imports scipy, and most logs have no nodes.
    from ipsys_log.statistics.calibrated_cameras import find_contradicted_clocks

    for one in find_contradicted_clocks(joint[-1], session.payloads(topics)):
        yield LogFinding("time", REMARK, one.text, _ADVICE, channels.clock_topic(one.camera))
