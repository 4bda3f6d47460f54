"""Import of other data into a log: recordings, tables, and the ground truth of another system."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import console, print_result, progress_bar, say, warn
from ipsys_log.app.cli.lab_inputs import load_calibrations, read_lab, say_remark, say_unusual
from ipsys_log.app.cli.options import appended_log_option, log_option, option, read_files, with_options
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.plain_text import shell_words

_MCAP_MAGIC = b"\x89MCAP"
_PROFILE = slice(21, 25)  # the place of "ros2" in the header of an MCAP file
_LONGEST_HEADER = 10_000  # bytes
_START = "2020-01-01T00:00:00Z"

_SOURCES = Annotated[
    list[Path],
    typer.Argument(
        metavar="SOURCE",
        help="A folder with a sub-folder of images per camera; a video of each camera (red=red.mp4); a bag "
        "of ROS 1 (.bag) or ROS 2 (a folder or a .db3 file); a table (.csv); trajectories (.tum, .tsv, .trc, "
        ".c3d); or the folder of the paper's data.",
    ),
]
_NEW_LOG = log_option(help="The log to write. Without --into, tables need --rig, too.")
_INTO = appended_log_option(
    help="For truth: the log of the same drive. For detections: a log without images. It gets a run."
)
# The options of all kinds.
_OPTIONS: dict[str, cli.Option] = {
    "into": (Annotated[Path | None, _INTO], None),
    "rig": (cli.RigFile, None),
    "calibration": (cli.Calibrations, None),
    "rate": option(float | None, "--rate", "HZ", "Images per second, if they have no times. Default: 1."),
    "times": option(
        str | None, "--times", "FILE|names",
        "Times of the images: a CSV file with the columns file (red/0001.jpg) and time, or names if the file "
        "names are times. A time is in s, ms, us or ns since 1970, or like 2024-05-31T12:30:00.25Z.",
    ),
    "start": option(
        str | None, "--start", "TIME", "Start of all videos: s since 1970, or ISO 8601. Default: 2020."
    ),
    "camera": option(
        list[str] | None, "--camera", "NAME=TOPIC",
        "Import this ROS topic of images or detections as the camera NAME; repeat it for each camera. "
        "Default: all such topics.",
    ),
    "robot": option(
        list[str] | None, "--robot", "NAME",
        "The robot of a trajectory that names none; repeat it in the order of the files. NAME=BODY selects a "
        "body of a file, a topic of a bag, or frames: ada=/tf:map.base_link.",
    ),
    "run": option(
        str | None, "--run", "NAME",
        "For truth: compare with the tracks of this run (default: the newest). For detections: name of the "
        "new run.",
    ),
    "align": option(
        str | None, "--align", "2d|3d|none",
        "For truth: estimate rotation and translation on the floor (2d, the default), in space (3d), or "
        "none.",
    ),
    "time_offset": option(
        str | None, "--time-offset", "S", "For truth: add this to the times, instead of an estimate."
    ),
    "pivot": option(
        str | None, "--pivot", "X,Y,Z",
        "For truth: from the marker to the body in m, in the axes of the marker, instead of an estimate.",
    ),
    "time_unit": option(
        str | None, "--time-unit", "s|ms|us|ns", "Unit of a time column whose header has none."
    ),
    "length_unit": option(
        str | None, "--length-unit", "m|cm|mm", "Unit of x, y and z whose header has none."
    ),
    "as_json": (cli.AsJson, False),
}  # fmt: skip


@with_options(
    {
        "sources": (_SOURCES, cli.REQUIRED),
        "output": (Annotated[Path | None, _NEW_LOG], None),
        "kind": option(
            str | None,
            "--as",
            "KIND",
            "Kind of the source, if its name and content do not show it: images, videos, ros, truth, "
            "detections, pairs or imsel (the data of the paper).",
        ),
        **_OPTIONS,
    }
)
def import_(sources: list[Path], output: Path | None, kind: str | None, **options: Any) -> None:
    """Import recordings, tables or ground truth of other programs into a log.

    Images, videos and ROS bags become a recording. Their bytes stay as they are. Without --times, images with
    the same number have the same time. Videos start at the same time. The other commands read MCAP bags of
    ROS 2 without an import.

    truth: tracks of another system, such as Vicon or OptiTrack, for scores. The command estimates the time
    offset and the rigid alignment to the tracks of a run. An alignment hides constant errors of the tracks.

    detections: markers of another program, for all stages after the detection: a table with the columns of
    ipsys export --table markers, or a ROS bag (also .mcap) with AprilTag detections.

    pairs: calibration points with their camera points, for fit, evaluate and plan. The columns are those of
    ipsys export --table pairs.

    Examples

        ipsys import photos -o lab.mcap --rig lab.toml      # images
        ipsys import red=red.mp4 white=white.mp4 -o lab.mcap
        ipsys import lab.bag -o lab.mcap                    # a ROS bag
        ipsys import vicon.csv --into monday.mcap           # ground truth
        ipsys import --as detections drive.mcap -o lab.mcap --rig lab.toml
    """
    for source in sources if kind != "truth" else ():
        _refuse_log(Path(str(source).rpartition("=")[2]), kind)
    kind = kind or _find_kind(sources[0])
    if kind == "ros" and options["into"] and not output:
        kind = "truth"  # a bag with images becomes a new log
    if kind not in KINDS:
        raise IpsysError(f"--as {kind}: is not a kind of source; use one of {', '.join(KINDS)}")
    _import_as(kind, sources, output, options)


def _import_as(kind: str, sources: list[Path], output: Path | None, options: dict[str, Any]) -> None:
    """Call the importer of a kind with its options; refuse options that other kinds have."""
    importer = KINDS[kind]
    read = {*inspect.signature(importer).parameters}
    for name, value in options.items():
        if value and name not in read:
            option = {"as_json": "json"}.get(name, name.replace("_", "-"))
            raise IpsysError(f"--{option}: has no effect for {kind}; leave it out")
    if "sources" not in read and len(sources) > 1:
        raise IpsysError(f"{sources[1]}: only one source of the kind {kind} can be imported at a time")
    if "into" not in read and output is None:
        raise IpsysError("-o is missing; give the name of the new log")
    given = {"source": sources[0], "sources": sources, "output": output, **options}
    importer(**{name: value for name, value in given.items() if name in read})


def _find_kind(source: Path) -> str:
    """Return the kind of a source by its name, its files, or the header of its table."""
    suffix = source.suffix.lower()
    if not source.exists():
        if "=" in str(source):
            return "videos"
        raise IpsysError(f"{source}: does not exist; name a file or a folder, or camera=file.mp4")
    if source.is_dir():
        if (source / "metadata.yaml").exists() or any(source.glob("*.db3")):
            return "ros"
        return "imsel" if any(source.rglob("testing.mat")) else "images"
    if suffix in (".bag", ".db3"):
        return "ros"
    if suffix == ".csv":
        with source.open("rb") as file:
            header = file.readline(_LONGEST_HEADER)
        return "pairs" if b"xc_m" in header else "detections" if b"x0_px" in header else "truth"
    if suffix in (".tum", ".tsv", ".trc", ".c3d", ".txt", ".dat"):
        return "truth"
    raise IpsysError(
        f"{source}: its kind is not known; name it with --as, or a video as camera={source.name}"
    )


def _import_imsel(source: Path, output: Path) -> None:
    from ipsys_log.engine.output import write_log
    from ipsys_log.exchange.imsel import read_imsel

    counts = write_log(output, read_imsel(source))
    console.print(f"{output} written: {sum(counts.values())} messages on {len(counts)} channels")


def _import_images(
    source: Path,
    output: Path,
    rig: Path | None,
    calibration: list[str] | None,
    rate: float | None,
    times: str | None,
) -> None:
    from ipsys_log.engine.output import write_log
    from ipsys_log.exchange.calibration_files import announce_assumed
    from ipsys_log.exchange.image_folders import find_images, find_times, read_images

    pictures = find_images(source)
    taken_ns = find_times(pictures, times) if times else None
    lab, lenses, assumed = read_lab(rig, calibration, pictures)
    rate_hz = 1.0 if rate is None else rate
    write_log(output, announce_assumed(read_images(pictures, lab, lenses, rate_hz, taken_ns), assumed))
    if not times and len({len(paths) for paths in pictures.values()}) > 1:
        say("the cameras have different numbers of images: images with the same number get the same time")
    counts = ", ".join(f"{len(paths)} of {camera}" for camera, paths in pictures.items())
    console.print(f"{output} written: images: {counts}")


def _import_videos(
    sources: list[Path], output: Path, rig: Path | None, calibration: list[str] | None, start: str | None
) -> None:
    from ipsys_log.capture.video_files import read_videos
    from ipsys_log.engine.output import write_log
    from ipsys_log.exchange.calibration_files import announce_assumed
    from ipsys_log.exchange.image_folders import parse_start

    paths = _by_camera([str(source) for source in sources])
    lab, lenses, assumed = read_lab(rig, calibration, paths)
    messages = read_videos(paths, lab, lenses, parse_start(start or _START), say)
    counts = write_log(output, announce_assumed(messages, assumed))
    text = ", ".join(f"{counts.get(f'/cameras/{camera}/image', 0)} of {camera}" for camera in paths)
    console.print(f"{output} written: frames: {text}")


def _import_ros(
    source: Path, output: Path, camera: list[str] | None, rig: Path | None, calibration: list[str] | None
) -> None:
    from ipsys_log.engine.output import write_log

    check_installed("import of ROS bags needs", "rosbags")
    from ipsys_log.exchange.calibration_files import announce_assumed
    from ipsys_log.exchange.ros_bags import find_bag_cameras, read_bag

    cameras = find_bag_cameras(source, _split_names(camera or [], "topic", "--camera red=/red/image_raw"))
    lab, lenses, assumed = read_lab(rig, calibration, cameras.images)
    with progress_bar(("bag",)) as progress:
        messages = read_bag(source, cameras, lab, lenses, progress)
        counts = write_log(output, announce_assumed(messages, assumed))
    text = ", ".join(f"{counts.get(f'/cameras/{name}/image', 0)} of {name}" for name in cameras.images)
    console.print(f"{output} written: images: {text}")


def _import_truth(
    sources: list[Path],
    output: Path | None,
    into: Path | None,
    robot: list[str] | None,
    run: str | None,
    align: str | None,
    time_offset: str | None,
    pivot: str | None,
    time_unit: str | None,
    length_unit: str | None,
    rig: Path | None,
    as_json: bool,
) -> None:
    from ipsys_log.app.report.comparison import truth_json, truth_lines
    from ipsys_log.exchange.import_truth import TruthOptions, import_truth
    from ipsys_log.exchange.trajectory_columns import GivenUnits
    from ipsys_log.exchange.trajectory_tables import parse_offset, parse_pivot
    from ipsys_log.messages.rig_file import load_rig

    options = TruthOptions(
        tuple(robot or ()),
        GivenUnits(time_unit, length_unit),
        align or "2d",
        None if time_offset is None else parse_offset(time_offset),
        None if pivot is None else parse_pivot(pivot),
        run,
        load_rig(rig) if rig else None,
    )
    with progress_bar(("bag",)) as progress:
        imported = import_truth(sources, into, output, options, say, progress)
    print_result(truth_json(imported), truth_lines(imported), as_json)
    say(f"results are in {imported.path}")


def _import_detections(
    source: Path,
    output: Path | None,
    into: Path | None,
    run: str | None,
    rig: Path | None,
    calibration: list[str] | None,
    camera: list[str] | None,
) -> None:
    from ipsys_log.exchange.import_tables import DetectionOptions, import_detections
    from ipsys_log.messages.rig_file import load_rig

    lab = load_rig(rig) if rig else None
    cameras = [rig_camera.name for rig_camera in lab.cameras] if lab else []
    topics = _split_names(camera or [], "topic", "--camera red=/red/detections")
    assumed: dict[str, str] = {}
    lenses = load_calibrations(calibration, lambda: cameras, assumed.__setitem__)
    imported = import_detections(
        source, into, output, DetectionOptions(lab, lenses, run, rig, assumed, topics)
    )
    for name in sorted(imported.assumed.keys() - assumed.keys()):
        say_remark(name, imported.assumed[name])
    say_unusual(imported.lenses)
    text = ", ".join(f"{count} of {name}" for name, count in imported.markers.items())
    console.print(f"run {imported.run}: markers: {text}")
    for line in imported.remarks:
        warn(line)
    say(f"results are in {imported.path}")


def _import_pairs(source: Path, output: Path, rig: Path | None) -> None:
    from ipsys_log.engine.output import write_log
    from ipsys_log.exchange.import_tables import pair_messages, read_pairs
    from ipsys_log.messages.rig_file import load_rig

    if rig is None:
        raise IpsysError("--rig is missing; name the rig file (lab.toml) of the lab")
    lab = load_rig(rig)
    table = read_pairs(source, lab)
    write_log(output, pair_messages(table, source, lab))
    text = ", ".join(f"{count} of {camera}" for camera, count in table.cameras.items())
    console.print(f"{output} written: calibration points: {len(table.points)} (seen: {text})")


KINDS: dict[str, Callable[..., None]] = {
    "images": _import_images,
    "videos": _import_videos,
    "ros": _import_ros,
    "truth": _import_truth,
    "detections": _import_detections,
    "pairs": _import_pairs,
    "imsel": _import_imsel,
}


def _refuse_log(path: Path, kind: str | None) -> None:
    """Refuse a file that is a log already, by its first bytes; a bag of ROS 2 can have detections."""
    try:
        with path.open("rb") as file:
            head = file.read(_PROFILE.stop)
    except OSError:
        return  # a folder, or no file: the importer reports it
    if head.startswith(_MCAP_MAGIC) and not (kind == "detections" and head[_PROFILE] == b"ros2"):
        raise IpsysError(
            f"{path}: is already a log and needs no import. To list its contents: "
            f"ipsys info {shell_words(path)}; "
            f"to process it: ipsys replay {shell_words(path)}"
        )


def _by_camera(files: list[str]) -> dict[str, Path]:
    named = _split_names(files, "video", "camera=file.mp4")
    paths = {camera: Path(name) for camera, name in named.items()}
    read_files([*paths.values()])
    return paths


def _split_names(words: list[str], kind: str, example: str) -> dict[str, str]:
    """Return the texts after the equals signs of words such as ``red=red.mp4``, by camera."""
    from ipsys_log.messages.rig_file import check_name

    named: dict[str, str] = {}
    for word in words:
        camera, equals, text = word.partition("=")
        if not equals:
            raise IpsysError(f"{word}: has no camera name; write {example}")
        if check_name(camera, f"{word}: camera name") in named:
            raise IpsysError(f"{word}: camera {camera!r} has two {kind}s; give one")
        named[camera] = text
    return named
