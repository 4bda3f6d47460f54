"""Import of ground truth from another system: its clock and coordinates become those of the lab."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ipsys_log.engine.output import append_run, open_target
from ipsys_log.engine.provenance import fingerprint, free_name, newest_run, read_channels
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.ground_truth_files import (
    LENGTH_UNITS,
    TIME_UNITS,
    TruthPath,
    TruthUnits,
    read_truth_files,
)
from ipsys_log.exchange.truth_alignment import (
    ALIGNMENTS,
    Residuals,
    RigidMotion,
    TruthAlignment,
    align_truth,
    residuals_of,
)
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, RIG_TOPIC, TRUTH_TOPIC, Message, Rig, Run, Track, Tracks
from ipsys_log.messages.channels import RIG, TRACKS, TRUTH
from ipsys_log.messages.rig_file import check_robots
from ipsys_log.statistics.calibration_points import TimedPoints
from ipsys_log.statistics.ground_truth import gather_tracks
from ipsys_log.statistics.path_pairs import PathPair
from ipsys_log.units import NS_PER_S, format_time

_RUN = "truth"
_MARKER_PREFIX = "marker_"


@dataclass(frozen=True, slots=True)
class TruthOptions:
    """The options of an import.

    Attributes
    ----------
    robots : the robot of each file that names none.
    align : ``2d``, ``3d`` or ``none``.
    time_offset_ns : to add to the times of the files; None to estimate it.
    run : the run whose tracks are compared; None: the newest complete one.
    rig : replaces the rig of the log.
    """

    robots: tuple[str, ...] = ()
    units: TruthUnits | None = None
    align: str = "2d"
    time_offset_ns: int | None = None
    run: str | None = None
    rig: Rig | None = None


@dataclass(frozen=True, slots=True)
class ImportedTruth:
    """The result of an import.

    Attributes
    ----------
    path : the log with the truth.
    record : the record of the run, with all parameters of the import.
    tracks_run : the run whose tracks were compared; None if there was none.
    poses : number of true poses by robot.
    alignment : None if nothing was estimated. ``residuals`` are against the tracks, if there are any.
    """

    path: Path
    record: Run
    tracks_run: str | None
    poses: dict[str, int]
    time_offset_ns: int
    alignment: TruthAlignment | None
    residuals: Residuals | None


def import_truth(
    files: Sequence[Path], into: Path | None, output: Path | None, options: TruthOptions
) -> ImportedTruth:
    """Write the ground truth of files on the channel ``/truth/tracks``, in the lab's clock and coordinates.

    Parameters
    ----------
    into : the log of the same drive, which gets the truth unless there is an ``output``.
    output : a new log for the truth.

    Raises
    ------
    IpsysError
        A file or an option is wrong, the rig does not have a robot, the truth does not fit the tracks, or the
        log has ground truth already. Nothing is written then.
    """
    _check_options(into, output, options)
    paths = read_truth_files(files, options.robots, options.units)
    where = ", ".join(map(str, files))
    with ExitStack() as stack:
        session = stack.enter_context(Session([into])) if into is not None else None
        ids = _marker_ids(_rig(session, options.rig), paths, where)
        if session is not None and session.topics(TRUTH):
            raise IpsysError(f"{session}: has ground truth already; import into a log without it")
        run = _tracks_run(session, options.run)
        tracks = _tracks(session, run, ids)
        fitted = _fit(paths, tracks, options, session, run, where)
        record = _record(files, options, fitted, session, run if tracks else None)
        messages = list(_messages(paths, ids, fitted, where))
        last_ns = messages[-1].log_time_ns
        record = replace(record, timestamp=last_ns)
        if session is None:  # a new log: its rig comes first
            messages.insert(0, replace(messages[0], topic=RIG_TOPIC, payload=options.rig))
        _, target = stack.enter_context(open_target([into] if into is not None else [], output))
        record = append_run(target, record, last_ns, lambda: messages, {})
    return ImportedTruth(
        output or target,
        record,
        run if tracks else None,
        {path.robot: len(path.times_ns) for path in paths},
        fitted.time_offset_ns,
        fitted.alignment,
        fitted.residuals,
    )


def _check_options(into: Path | None, output: Path | None, options: TruthOptions) -> None:
    if into is None and output is None:
        raise IpsysError("no log is named; give --into LOG, or -o LOG for a new one")
    units = options.units or TruthUnits()
    for option, value, known in (
        ("--align", options.align, [*ALIGNMENTS]),
        ("--time-unit", units.time, [None, *TIME_UNITS]),
        ("--length-unit", units.length, [None, *LENGTH_UNITS]),
    ):
        if value not in known:
            names = ", ".join(str(name) for name in known if name is not None)
            raise IpsysError(f"{option} {value}: is not known; use one of {names}")


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    time_offset_ns: int
    motion: RigidMotion | None
    alignment: TruthAlignment | None = None
    residuals: Residuals | None = None


def _rig(session: Session | None, given: Rig | None) -> Rig:
    if given is not None:
        return given
    rigs: list[Rig] = session.payloads(session.topics(RIG)) if session is not None else []
    if not rigs:
        raise IpsysError(
            f"{session or 'ground truth'}: has no rig with the markers of robots; add --rig FILE"
        )
    return rigs[-1]


def _marker_ids(rig: Rig, paths: Sequence[TruthPath], where: str) -> dict[str, int]:
    """Return the id of the marker of each robot; a rig without markers has robots ``marker_<id>``."""
    check_robots(rig, [path.robot for path in paths], where)
    ids = {rig.robot_of(marker.id): marker.id for marker in rig.markers}
    return {
        path.robot: ids[path.robot] if ids else int(path.robot.removeprefix(_MARKER_PREFIX)) for path in paths
    }


def _tracks(session: Session | None, run: str | None, ids: dict[str, int]) -> dict[str, TimedPoints]:
    """Return the tracks of a run by robot, for the robots with a track."""
    if session is None or run is None:
        return {}
    tracks = gather_tracks(session.messages(session.topics(TRACKS, run)))
    return {robot: tracks[marker_id] for robot, marker_id in ids.items() if marker_id in tracks}


def _tracks_run(session: Session | None, run: str | None) -> str | None:
    if session is None:
        return None
    if run is None:
        return newest_run(session, TRACKS)
    if not session.topics(TRACKS, run):
        known = [name for name in sorted(session.run_names()) if session.topics(TRACKS, name)]
        raise IpsysError(f"{session}: run {run} has no tracks (they are in: {', '.join(known) or 'none'})")
    return run


def _fit(
    paths: Sequence[TruthPath],
    tracks: dict[str, TimedPoints],
    options: TruthOptions,
    session: Session | None,
    run: str | None,
    where: str,
) -> _Fitted:
    """Return the offset and the motion: estimated, or given by the options."""
    given_ns = options.time_offset_ns
    if given_ns is not None and session is not None:
        _check_overlap(paths, given_ns, tracks, session, where)
    if options.align == "none" and given_ns is not None:
        return _Fitted(given_ns, None, residuals=_given_residuals(paths, tracks, given_ns))
    if not tracks:
        raise IpsysError(_no_tracks(paths, session, run))
    pairs, zero_ns = _pairs(paths, tracks)
    offset_s = None if given_ns is None else (given_ns - zero_ns) / NS_PER_S
    found = align_truth(pairs, options.align, where, offset_s)
    offset_ns = zero_ns + round(found.offset_s * NS_PER_S) if given_ns is None else given_ns
    return _Fitted(offset_ns, None if options.align == "none" else found.motion, found, found.residuals)


def _given_residuals(
    paths: Sequence[TruthPath], tracks: dict[str, TimedPoints], offset_ns: int
) -> Residuals | None:
    if not tracks:
        return None
    pairs, zero_ns = _pairs(paths, tracks)
    return residuals_of(pairs, (offset_ns - zero_ns) / NS_PER_S, RigidMotion(np.eye(3), np.zeros(3)))


def _no_tracks(paths: Sequence[TruthPath], session: Session | None, run: str | None) -> str:
    names = ", ".join(path.robot for path in paths)
    lacks = "a log without tracks" if session is None else f"{session}: has no tracks"
    if run is not None:
        lacks = f"{session}: run {run} has no track of {names}"
    return (
        f"{lacks}: no time offset or alignment can be estimated; run 'ipsys replay' first, or give "
        "--align none --time-offset S"
    )


def _check_overlap(
    paths: Sequence[TruthPath], offset_ns: int, tracks: dict[str, TimedPoints], session: Session, where: str
) -> None:
    start_ns = min(int(path.times_ns[0]) for path in paths) + offset_ns
    end_ns = max(int(path.times_ns[-1]) for path in paths) + offset_ns
    ends_ns = [int(track.times_ns[place]) for track in tracks.values() for place in (0, -1)]
    first_ns, last_ns = min(ends_ns, default=session.start_ns), max(ends_ns, default=session.end_ns)
    if end_ns < first_ns or start_ns > last_ns:
        raise IpsysError(
            f"{where}: does not overlap in time with {session}: the truth is from {_time(start_ns)} to "
            f"{_time(end_ns)}, {'the tracks are' if tracks else 'the log is'} from {_time(first_ns)} to "
            f"{_time(last_ns)}; check --time-offset"
        )


def _time(time_ns: int) -> str:
    # A clock that starts at zero, with a wrong offset, gives times that no calendar has.
    return format_time(time_ns) if 0 <= time_ns < 1 << 63 else f"{time_ns / NS_PER_S:.3f} s"


def _pairs(paths: Sequence[TruthPath], tracks: dict[str, TimedPoints]) -> tuple[list[PathPair], int]:
    """Return the paths of both systems, each in s since its start, and the difference of the starts in ns."""
    true_ns = min(int(path.times_ns[0]) for path in paths)
    track_ns = min(int(track.times_ns[0]) for track in tracks.values())
    pairs = []
    for path in paths:
        if path.robot in tracks:
            track = tracks[path.robot]
            # Tracks of earlier versions have several poses at an instant; the last one uses all cameras.
            times_ns, last = np.unique(track.times_ns[::-1], return_index=True)
            true_s, track_s = (path.times_ns - true_ns) / NS_PER_S, (times_ns - track_ns) / NS_PER_S
            pairs.append(PathPair(true_s, path.points_m, track_s, track.points_m[::-1][last]))
    return pairs, track_ns - true_ns


def _messages(
    paths: Sequence[TruthPath], ids: dict[str, int], fitted: _Fitted, where: str
) -> Iterator[Message]:
    """Yield the poses of all robots by instant."""
    by_time: dict[int, list[Track]] = defaultdict(list)
    for path in paths:
        points_m, forward = path.points_m, path.forward
        if fitted.motion is not None:
            points_m, forward = fitted.motion.apply(points_m), forward @ fitted.motion.rotation.T
        rows = zip(path.times_ns.tolist(), points_m.tolist(), forward.tolist(), strict=True)
        for time_ns, (x_m, y_m, z_m), (ahead, left, _) in rows:
            heading_rad = float(np.arctan2(left, ahead)) if np.isfinite(ahead) else None
            track = Track(path.robot, ids[path.robot], x_m, y_m, z_m, heading_rad)
            by_time[time_ns + fitted.time_offset_ns].append(track)
    if min(by_time) < 0 or max(by_time) >= 1 << 62:
        raise IpsysError(
            f"{where}: the times in the clock of the lab are before 1970 or after 2116; check --time-offset"
        )
    for time_ns in sorted(by_time):
        tracks = tuple(sorted(by_time[time_ns], key=lambda track: track.id))
        yield Message(TRUTH_TOPIC, time_ns, time_ns, Tracks(time_ns, tracks))


def _record(
    files: Sequence[Path], options: TruthOptions, fitted: _Fitted, session: Session | None, run: str | None
) -> Run:
    """Return the record of the import, without its time and its outputs."""
    parameters = {
        "format": " ".join(sorted({path.suffix.lower().removeprefix(".") for path in files})),
        "files": " ".join(path.name for path in files),
        "align": options.align,
        "time_offset_s": _seconds(fitted.time_offset_ns),
        **_numbers(fitted),
    }
    record = Run(0, _RUN, IMPORTED, parameters, fingerprint(), number=1)
    if session is None:
        return record
    return replace(
        record,
        run=free_name(session, record, _RUN, (TRUTH,)),
        input_runs=() if run is None else (run,),
        inputs=() if run is None else read_channels(session, session.topics(TRACKS, run)),
        number=max((other.number for other in session.runs()), default=0) + 1,
    )


def _numbers(fitted: _Fitted) -> dict[str, str]:
    """Return the estimates with all digits, and standard deviations and residuals with a few, as texts."""
    estimates: dict[str, float] = {}
    errors: dict[str, float] = {}
    found, motion = fitted.alignment, fitted.motion
    if found is not None and found.offset_sigma_s is not None:
        errors["time_offset_sigma_s"] = found.offset_sigma_s
    if found is not None and motion is not None:
        for axis, name in enumerate("xyz"):
            if np.isfinite(found.turn_sigmas_rad[axis]):
                estimates[f"rotation_{name}_rad"] = float(found.turn_rad[axis])
                errors[f"rotation_{name}_sigma_rad"] = float(found.turn_sigmas_rad[axis])
            if np.isfinite(found.shift_sigmas_m[axis]):
                estimates[f"translation_{name}_m"] = float(motion.shift_m[axis])
                errors[f"translation_{name}_sigma_m"] = float(found.shift_sigmas_m[axis])
    if (residuals := fitted.residuals) is not None:
        errors |= {"rmse_2d_m": residuals.rmse_2d_m, "rmse_3d_m": residuals.rmse_3d_m}
        estimates |= {"instants": residuals.instants, "outliers": residuals.outliers}
    return {name: repr(value) for name, value in estimates.items()} | {
        name: f"{value:.4g}" for name, value in errors.items()
    }


def _seconds(time_ns: int) -> str:
    whole, rest = divmod(abs(time_ns), NS_PER_S)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}"
