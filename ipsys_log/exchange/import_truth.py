"""Import of ground truth from another system: its clock and coordinates become those of the lab."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ipsys_log.engine.output import append_run, open_target
from ipsys_log.engine.provenance import fingerprint, free_name, newest_run, next_number, read_channels
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.trajectory_columns import GivenUnits
from ipsys_log.exchange.trajectory_files import Wanted, assign_robots, read_trajectories, selected_bodies
from ipsys_log.exchange.trajectory_tables import LENGTH_UNITS, TIME_UNITS
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, RIG_TOPIC, TRUTH_TOPIC, Message, Rig, Run, Track, Tracks
from ipsys_log.messages.channels import RIG, TRACKS, TRUTH
from ipsys_log.messages.rig_file import check_robots
from ipsys_log.statistics.ground_truth import LONGEST_GAP_NS, TrackedPath, gather_paths, last_poses
from ipsys_log.statistics.path_alignment import PathAlignment, Residuals, align_trajectories, seconds_text
from ipsys_log.statistics.path_cleaning import select_rows
from ipsys_log.statistics.path_pairs import PathPair, common_instants
from ipsys_log.statistics.path_problem import ALIGNMENTS
from ipsys_log.statistics.trajectories import KnownParts, Trajectory, TrajectoryPair
from ipsys_log.units import NS_PER_S, format_time
from ipsys_log.vision.poses import rotation_vector, turns_about_z
from ipsys_log.vision.time_brackets import bracket_times

_RUN = "truth"
# Parameters of the record that are no numbers.
TEXTS = ("format", "files", "align", "axes", "remarks")
_MARKER_PREFIX = "marker_"


@dataclass(frozen=True, slots=True)
class TruthOptions:
    """The options of an import.

    Attributes
    ----------
    robots : the robot of each file that names none, or ``NAME=BODY`` for a body of a file.
    align : ``2d``, ``3d`` or ``none``.
    time_offset_ns : to add to the times of the files; None to estimate it.
    pivot_m : from the marker to the origin of the other body, in the axes of the marker; None to estimate it.
    run : the run whose tracks are compared; None: the newest complete one.
    rig : replaces the rig of the log.
    """

    robots: tuple[str, ...] = ()
    units: GivenUnits | None = None
    align: str = "2d"
    time_offset_ns: int | None = None
    pivot_m: tuple[float, float, float] | None = None
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
    alignment: PathAlignment | None
    residuals: Residuals | None


def import_truth(
    files: Sequence[Path],
    into: Path | None,
    output: Path | None,
    options: TruthOptions,
    say: Callable[[str], None] = lambda line: None,
    progress: Progress = lambda step, done, total: None,
) -> ImportedTruth:
    """Write the ground truth of files on the channel ``/truth/tracks``, in the lab's clock and coordinates.

    Parameters
    ----------
    into : the log of the same drive, which gets the truth unless there is an ``output``.
    output : a new log for the truth.
    say : called with what was understood of each file, before anything is written.

    Raises
    ------
    IpsysError
        A file or an option is wrong, the rig does not have a robot, the truth does not fit the tracks, or the
        log has ground truth already. Nothing is written then.
    """
    _check_options(into, output, options)
    wanted = Wanted(selected_bodies(options.robots), options.units)
    read = [read_trajectories(path, wanted, progress) for path in files]
    for line in (line for one in read for line in (*one.understood, *one.remarks)):
        say(line)
    where = ", ".join(map(str, files))
    with ExitStack() as stack:
        session = stack.enter_context(Session([into])) if into is not None else None
        rig = _rig(session, options.rig)
        known = {rig.robot_of(marker.id) for marker in rig.markers}
        paths = assign_robots(read, options.robots, known)
        ids = _marker_ids(rig, paths, where)
        if session is not None and session.topics(TRUTH):
            raise IpsysError(f"{session}: has ground truth already; import into a log without it")
        run = _tracks_run(session, options.run)
        tracks = _tracks(session, run, ids)
        fitted = _fit(paths, tracks, options, session, run, where)
        record = _record(files, options, fitted, session, run if tracks else None)
        tilted = {body.robot for body in rig.bodies if not body.level}
        messages = list(_messages(fitted, ids, tilted, where))
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
        {path.name: len(path.times_ns) for path in fitted.poses},
        fitted.time_offset_ns,
        fitted.alignment,
        fitted.residuals,
    )


def _check_options(into: Path | None, output: Path | None, options: TruthOptions) -> None:
    if into is None and output is None:
        raise IpsysError("no log is named; give --into LOG, or -o LOG for a new one")
    check_choices(options.align, options.units or GivenUnits())
    if options.pivot_m is not None and options.align == "none" and options.time_offset_ns is not None:
        raise IpsysError("--pivot: has no effect with --align none and --time-offset; leave it out")


def check_choices(align: str, units: GivenUnits) -> None:
    """Check the values of ``--align``, ``--time-unit`` and ``--length-unit``."""
    for option, value, known in (
        ("--align", align, [*ALIGNMENTS]),
        ("--time-unit", units.time, [None, *TIME_UNITS]),
        ("--length-unit", units.length, [None, *LENGTH_UNITS]),
    ):
        if value not in known:
            names = ", ".join(str(name) for name in known if name is not None)
            raise IpsysError(f"{option} {value}: is not known; use one of {names}")


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """The poses of the markers in the lab, and how they came there."""

    poses: Sequence[Trajectory]
    time_offset_ns: int
    alignment: PathAlignment | None = None
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


def _marker_ids(rig: Rig, paths: Sequence[Trajectory], where: str) -> dict[str, int]:
    """Return the id of the marker of each robot; a rig without markers has robots ``marker_<id>``."""
    check_robots(rig, [path.name for path in paths], where)
    ids = {rig.robot_of(marker.id): marker.id for marker in rig.markers}
    return {
        path.name: ids[path.name] if ids else int(path.name.removeprefix(_MARKER_PREFIX)) for path in paths
    }


def _tracks(session: Session | None, run: str | None, ids: dict[str, int]) -> dict[str, TrackedPath]:
    """Return the tracks of a run by robot, for the robots with a track."""
    if session is None or run is None:
        return {}
    tracks = gather_paths(session.messages(session.topics(TRACKS, run)))
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
    paths: Sequence[Trajectory],
    tracks: dict[str, TrackedPath],
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
        poses = [replace(path, times_ns=path.times_ns + given_ns) for path in paths]
        return _Fitted(poses, given_ns, residuals=_given_residuals(poses, tracks))
    if not tracks:
        raise IpsysError(_no_tracks(paths, session, run))
    pairs = [TrajectoryPair(path, tracks[path.name]) for path in paths if path.name in tracks]
    found = align_trajectories(pairs, KnownParts(given_ns, options.align, options.pivot_m), where)
    numbers = {pair.other.name: number for number, pair in enumerate(pairs)}
    poses = [
        _marker_poses(found, numbers[path.name], tracks[path.name])
        if path.name in numbers
        else found.lab_poses(path)
        for path in paths
    ]
    return _Fitted(poses, found.offset_ns, found, found.residuals)


def _given_residuals(poses: Sequence[Trajectory], tracks: dict[str, TrackedPath]) -> Residuals | None:
    """Return the residuals of poses that are in the lab already; None without common instants."""
    pairs = []
    for path in (path for path in poses if path.name in tracks):
        track = tracks[path.name].positions
        rows, zero_ns = last_poses(track), min(int(path.times_ns[0]), int(track.times_ns[0]))
        true_s, track_s = (path.times_ns - zero_ns) / NS_PER_S, (track.times_ns[rows] - zero_ns) / NS_PER_S
        pairs.append(PathPair(true_s, path.points_m, track_s, track.points_m[rows]))
    common = common_instants(pairs, 0.0) if pairs else None
    if common is None or not len(common.track_m):
        return None
    return Residuals.of((common.track_m - common.true_m) ** 2)


def _marker_poses(alignment: PathAlignment, number: int, track: TrackedPath) -> Trajectory:
    """Return the poses of the marker of a robot, from those of the body of the other system.

    A body without rotations has the headings of the track.
    """
    from scipy.spatial.transform import Rotation

    poses, body = alignment.poses[number], alignment.bodies[number]
    axes, quaternions = poses.axes @ turns_about_z(np.array([-body.turn_rad])), poses.quaternions.copy()
    is_turned = np.isfinite(axes).all(axis=(1, 2))
    if is_turned.any():
        quaternions[is_turned] = Rotation.from_matrix(axes[is_turned]).as_quat()
    brackets = bracket_times(track.positions.times_ns, poses.times_ns, LONGEST_GAP_NS)
    rest = ~is_turned & brackets.is_known
    axes[rest] = turns_about_z(brackets.mix(np.asarray(np.unwrap(np.nan_to_num(track.headings_rad))))[rest])
    points_m = poses.points_m - (axes @ body.pivot_m if body.pivot_m.any() else 0.0)
    known = np.asarray(np.isfinite(points_m).all(axis=1))
    return select_rows(replace(poses, points_m=points_m, quaternions=quaternions), known)


def _no_tracks(paths: Sequence[Trajectory], session: Session | None, run: str | None) -> str:
    names = ", ".join(path.name for path in paths)
    lacks = "a log without tracks" if session is None else f"{session}: has no tracks"
    if run is not None:
        lacks = f"{session}: run {run} has no track of {names}"
    return (
        f"{lacks}: no time offset or alignment can be estimated; run 'ipsys replay' first, or give "
        "--align none --time-offset S"
    )


def _check_overlap(
    paths: Sequence[Trajectory], offset_ns: int, tracks: dict[str, TrackedPath], session: Session, where: str
) -> None:
    start_ns = min(int(path.times_ns[0]) for path in paths) + offset_ns
    end_ns = max(int(path.times_ns[-1]) for path in paths) + offset_ns
    ends_ns = [int(track.positions.times_ns[place]) for track in tracks.values() for place in (0, -1)]
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


def _messages(fitted: _Fitted, ids: dict[str, int], tilted: Collection[str], where: str) -> Iterator[Message]:
    """Yield the poses of all robots by instant; those of tilted bodies have full rotations."""
    by_time: dict[int, list[Track]] = defaultdict(list)
    for path in fitted.poses:
        axes = path.axes
        # The heading is that of the x axis.
        headings_rad = np.arctan2(axes[:, 1, 0], axes[:, 0, 0]).tolist()
        rows = zip(path.times_ns.tolist(), path.points_m.tolist(), headings_rad, axes, strict=True)
        for time_ns, (x_m, y_m, z_m), heading_rad, turn in rows:
            known = heading_rad if np.isfinite(heading_rad) else None
            vector_rad = rotation_vector(turn) if known is not None and path.name in tilted else None
            track = Track(path.name, ids[path.name], x_m, y_m, z_m, known, rotation_rad=vector_rad)
            by_time[time_ns].append(track)
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
        "time_offset_s": seconds_text(fitted.time_offset_ns),
    }
    if (found := fitted.alignment) is not None:
        parameters |= found.record_parameters([f"{robot}_" for robot in found.names])
    if (residuals := fitted.residuals) is not None:
        parameters |= {"rmse_2d_m": f"{residuals.rmse_2d_m:.4g}", "rmse_3d_m": f"{residuals.rmse_3d_m:.4g}"}
        parameters |= {"instants": str(residuals.instants), "outliers": str(residuals.outliers)}
    record = Run(0, _RUN, IMPORTED, parameters, fingerprint(), number=1)
    if session is None:
        return record
    return replace(
        record,
        run=free_name(session, record, _RUN, (TRUTH,)),
        input_runs=() if run is None else (run,),
        inputs=() if run is None else read_channels(session, session.topics(TRACKS, run)),
        number=next_number(session),
    )
