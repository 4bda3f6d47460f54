"""Import of other data into a log: recordings, tables, and the ground truth of another system."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.cli.console import console, print_json, progress_bar, remarks, say, warn
from ipsys_log.cli.local_files import read_files
from ipsys_log.cli.options import AsJson, Calibrations, NewLog, RigFile, appended_log_option, log_option
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from collections.abc import Collection

    from ipsys_log.exchange.import_truth import TruthOptions
    from ipsys_log.messages import CameraCalibration, Rig

_MCAP_MAGIC = b"\x89MCAP"


def add_commands(app: typer.Typer) -> None:
    group = typer.Typer(help="Convert other recordings into a log.", no_args_is_help=True)
    group.command("imsel")(imsel)
    group.command("images")(images)
    group.command("videos")(videos)
    group.command("ros")(ros)
    group.command("truth")(truth)
    group.command("detections")(detections)
    group.command("pairs")(pairs)
    app.add_typer(group, name="import")


def imsel(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder of the paper's data, or a clone of its repository."),
    ],
    output: NewLog,
) -> None:
    """Import the data of the paper (Ou et al., Robotica 2023): .mat files and camera YAML files."""
    _refuse_log(folder)
    from ipsys_log.exchange.imsel import read_imsel
    from ipsys_log.runs.output import write_log

    counts = write_log(output, read_imsel(folder))
    console.print(f"{output} written: {sum(counts.values())} messages on {len(counts)} channels")


def images(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A folder with one sub-folder of images per camera.")
    ],
    output: NewLog,
    rig: RigFile = None,
    calibration: Calibrations = None,
    rate: Annotated[
        float, typer.Option(metavar="HZ", help="Images per second, if they have no times.")
    ] = 1.0,
    times: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|names",
            help="Times of the images: a CSV file with the columns file (red/0001.jpg) and time, or names "
            "if the file names are times. A time is in s, ms, us or ns since 1970, or like "
            "2024-05-31T12:30:00.25Z.",
        ),
    ] = None,
) -> None:
    """Import a folder of images. Without --times, images with the same number have the same time."""
    from ipsys_log.exchange.calibration_files import announce_assumed
    from ipsys_log.exchange.image_folders import find_images, find_times, read_images
    from ipsys_log.runs.output import write_log

    _refuse_log(folder)
    pictures = find_images(folder)
    taken_ns = find_times(pictures, times) if times else None
    lab, lenses, assumed = _settings(rig, calibration, pictures)
    write_log(output, announce_assumed(read_images(pictures, lab, lenses, rate, taken_ns), assumed))
    if not times and len({len(paths) for paths in pictures.values()}) > 1:
        say("the cameras have different numbers of images: images with the same number get the same time")
    counts = ", ".join(f"{len(paths)} of {camera}" for camera, paths in pictures.items())
    console.print(f"{output} written: images: {counts}")


def videos(
    files: Annotated[
        list[str], typer.Argument(metavar="CAMERA=FILE", help="A video for each camera: red=red.mp4.")
    ],
    output: NewLog,
    rig: RigFile = None,
    calibration: Calibrations = None,
    start: Annotated[
        str, typer.Option(metavar="TIME", help="Start of all videos: s since 1970, or ISO 8601.")
    ] = "2020-01-01T00:00:00Z",
) -> None:
    """Import videos that start at the same time. The log gets MJPEG, H.264 and H.265 unchanged."""
    from ipsys_log.capture.video_files import read_videos
    from ipsys_log.exchange.calibration_files import announce_assumed
    from ipsys_log.exchange.image_folders import parse_start
    from ipsys_log.runs.output import write_log

    for option in files:
        _refuse_log(Path(option.rpartition("=")[2]))
    paths = _by_camera(files)
    lab, lenses, assumed = _settings(rig, calibration, paths)
    messages = read_videos(paths, lab, lenses, parse_start(start), remarks.print)
    counts = write_log(output, announce_assumed(messages, assumed))
    text = ", ".join(f"{counts.get(f'/cameras/{camera}/image', 0)} of {camera}" for camera in paths)
    console.print(f"{output} written: frames: {text}")


def ros(
    bag: Annotated[
        Path,
        typer.Argument(metavar="BAG", help="A bag of ROS 1 (.bag) or ROS 2 (a folder or a .db3 file)."),
    ],
    output: NewLog,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=TOPIC",
            help="Import the images of this topic as the camera NAME; repeat it for each camera. "
            "Default: all topics with images.",
        ),
    ] = None,
    rig: RigFile = None,
    calibration: Calibrations = None,
) -> None:
    """Import the images and intrinsics of a ROS bag. The times are the stamps of the images.

    Images are CompressedImage, or Image with mono8, bgr8, rgb8 or an alpha channel; their bytes stay as they
    are. The other commands read MCAP bags of ROS 2 without an import."""
    from ipsys_log.extras import check_installed
    from ipsys_log.runs.output import write_log

    check_installed("import ros needs", "rosbags")
    from ipsys_log.exchange.calibration_files import announce_assumed
    from ipsys_log.exchange.ros_bags import find_bag_cameras, read_bag

    _refuse_log(bag)
    cameras = find_bag_cameras(bag, _topic_of(camera or []))
    lab, lenses, assumed = _settings(rig, calibration, cameras.images)
    with progress_bar(("bag",)) as progress:
        messages = read_bag(bag, cameras, lab, lenses, progress)
        counts = write_log(output, announce_assumed(messages, assumed))
    text = ", ".join(f"{counts.get(f'/cameras/{name}/image', 0)} of {name}" for name in cameras.images)
    console.print(f"{output} written: images: {text}")


def truth(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE", help="A CSV table (.csv), or a TUM trajectory (.tum) of one robot."),
    ],
    into: Annotated[
        Path | None, appended_log_option(help="The log of the same drive; it gets the ground truth.")
    ] = None,
    output: Annotated[
        Path | None, log_option(help="A new log for the ground truth. Without --into, it needs --rig.")
    ] = None,
    robot: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="The robot of a file that names none; repeat it in the order of the files."
        ),
    ] = None,
    run: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Compare with the tracks of this run. Default: the newest."),
    ] = None,
    align: Annotated[
        str,
        typer.Option(
            metavar="2d|3d|none",
            help="Estimate rotation and translation on the floor (2d), in space (3d), or none.",
        ),
    ] = "2d",
    time_offset: Annotated[
        str | None,
        typer.Option(metavar="S", help="Add this to the times of the files, instead of an estimate."),
    ] = None,
    time_unit: Annotated[
        str | None, typer.Option(metavar="s|ns", help="Unit of a time column whose header has none.")
    ] = None,
    length_unit: Annotated[
        str | None, typer.Option(metavar="m|mm", help="Unit of x, y and z whose header has none.")
    ] = None,
    rig: RigFile = None,
    as_json: AsJson = False,
) -> None:
    """Import the ground truth of another system, such as Vicon or OptiTrack, for scores of the tracks.

    The command estimates the time offset and the rigid alignment to the tracks of a run, without a scale.
    An alignment hides constant errors of the tracks."""
    from ipsys_log.exchange.import_truth import import_truth
    from ipsys_log.report.truth_import import truth_json, truth_lines

    for file in files:
        _refuse_log(file)
    options = _truth_options(robot, run, align, time_offset, time_unit, length_unit, rig)
    imported = import_truth(files, into, output, options)
    if as_json:
        print_json(truth_json(imported))
    else:
        for line in truth_lines(imported):
            console.print(line)
    say(f"results are in {imported.path}")


def detections(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A CSV table of markers, one row for each marker.")
    ],
    into: Annotated[
        Path | None, appended_log_option(help="A log without images, which gets a new run.")
    ] = None,
    output: Annotated[
        Path | None, log_option(help="A new log for the markers. Without --into, it needs --rig.")
    ] = None,
    run: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the new run. Default: imported.")
    ] = None,
    rig: RigFile = None,
    calibration: Calibrations = None,
) -> None:
    """Import the detected markers of another program, for all stages after the detection.

    The columns are time, camera, marker_id, and x0_px, y0_px to x3_px, y3_px of the corners, clockwise from
    the top left of the marker. ipsys export --table markers writes such a table.
    """
    from ipsys_log.cli.options import load_calibrations, say_remark, say_unusual
    from ipsys_log.exchange.detection_tables import DetectionOptions, import_detections
    from ipsys_log.rig.file import load_rig

    _refuse_log(file)
    lab = load_rig(rig) if rig else None
    cameras = [camera.name for camera in lab.cameras] if lab else []
    assumed: dict[str, str] = {}
    lenses = load_calibrations(calibration, lambda: cameras, assumed.__setitem__)
    imported = import_detections(file, into, output, DetectionOptions(lab, lenses, run, rig, assumed))
    for name in sorted(imported.assumed.keys() - assumed.keys()):
        say_remark(name, imported.assumed[name])
    say_unusual(imported.lenses)
    text = ", ".join(f"{count} of {camera}" for camera, count in imported.markers.items())
    console.print(f"run {imported.run}: markers: {text}")
    for line in imported.remarks:
        warn(line)
    say(f"results are in {imported.path}")


def pairs(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="A CSV table, one row for each camera that saw a calibration point."
        ),
    ],
    output: NewLog,
    rig: Annotated[Path, typer.Option("--rig", metavar="FILE", help="The rig file (lab.toml) of the lab.")],
) -> None:
    """Import calibration points with their camera points, for fit, evaluate and plan.

    The columns are id, camera, xc_m, yc_m, zc_m in camera coordinates, and xw_m, yw_m, zw_m in the lab.
    Optional columns are marker_id, splits and calibration_point. ipsys export --table pairs writes such a
    table.
    """
    from ipsys_log.exchange.pair_tables import pair_messages, read_pairs
    from ipsys_log.rig.file import load_rig
    from ipsys_log.runs.output import write_log

    _refuse_log(file)
    lab = load_rig(rig)
    table = read_pairs(file, lab)
    write_log(output, pair_messages(table, file, lab))
    text = ", ".join(f"{count} of {camera}" for camera, count in table.cameras.items())
    console.print(f"{output} written: calibration points: {len(table.points)} (seen: {text})")


def _truth_options(
    robot: list[str] | None,
    run: str | None,
    align: str,
    time_offset: str | None,
    time_unit: str | None,
    length_unit: str | None,
    rig: Path | None,
) -> TruthOptions:
    from ipsys_log.exchange.ground_truth_files import TruthUnits, parse_offset
    from ipsys_log.exchange.import_truth import TruthOptions
    from ipsys_log.rig.file import load_rig

    return TruthOptions(
        tuple(robot or ()),
        TruthUnits(time_unit, length_unit),
        align,
        None if time_offset is None else parse_offset(time_offset),
        run,
        load_rig(rig) if rig else None,
    )


def _settings(
    rig: Path | None, calibration: list[str] | None, cameras: Collection[str]
) -> tuple[Rig | None, dict[str, CameraCalibration], dict[str, str]]:
    """Return the rig of an import, the intrinsics of its cameras, and texts on their assumed lens models.

    The intrinsics are the given ones, else those of the files that the rig names, as far as they exist.
    """
    from ipsys_log.cli.options import load_calibrations, load_matching_rig, say_remark, say_unusual
    from ipsys_log.exchange.lab_files import load_lenses

    assumed: dict[str, str] = {}
    lenses = load_calibrations(calibration, lambda: cameras, assumed.__setitem__)
    lab = load_matching_rig(rig, lambda: cameras)
    if rig is None or lab is None:
        return lab, lenses, assumed
    named = [camera for camera in lab.cameras if camera.name in cameras and camera.name not in lenses]
    for camera in named:
        if camera.calibration is not None and (rig.parent / camera.calibration).exists():
            from_rig = load_lenses(rig, [camera], {}, report=assumed.__setitem__)
            say_unusual(from_rig)
            lenses |= from_rig
        elif camera.calibration is not None:
            text = f"{camera.calibration} of the rig does not exist; 'ipsys calibrate' writes it"
            say_remark(camera.name, text)
        if camera.name in assumed:
            say_remark(camera.name, assumed[camera.name])
    return lab, lenses, assumed


def _refuse_log(path: Path) -> None:
    """Refuse a file that is a log already, by its first bytes."""
    from ipsys_log.errors import IpsysError

    try:
        with path.open("rb") as file:
            is_log = file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC
    except OSError:
        return  # a folder, or no file: the importer reports it
    if is_log:
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


def _topic_of(options: list[str]) -> dict[str, str]:
    return _split_names(options, "topic", "--camera red=/red/image_raw")


def _split_names(options: list[str], kind: str, example: str) -> dict[str, str]:
    """Return the texts after the equals signs of options such as ``red=red.mp4``, by camera."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.rig.file import check_name

    named: dict[str, str] = {}
    for option in options:
        camera, equals, text = option.partition("=")
        if not equals:
            raise IpsysError(f"{option}: has no camera name; write {example}")
        if check_name(camera, f"{option}: camera name") in named:
            raise IpsysError(f"{option}: camera {camera!r} has two {kind}s; give one")
        named[camera] = text
    return named
