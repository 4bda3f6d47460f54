"""Export of positions, images and other channels: ``ipsys export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import console, progress_bar
from ipsys_log.cli.options import ReadLogs

_COUNTED = ("bag", "video", "pictures")


def add_commands(app: typer.Typer) -> None:
    app.command()(export)


def export(
    logs: ReadLogs,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="The file to write. Its suffix gives the format: .csv, .parquet (tables), .tum, .kitti "
            "(trajectories), .mcap (ROS 2 bag), .mp4 (video). For --format coco: a new folder.",
        ),
    ],
    format_: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help="csv, parquet, tum, kitti, ros2, mp4 or coco. Default: by the name of the file.",
        ),
    ] = None,
    table: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="tracks, positions, markers, camera_points, pairs, measurements, events, latency or truth.",
        ),
    ] = "tracks",
    run: Annotated[
        list[str] | None,
        typer.Option(
            "--run", metavar="NAME", help="Export this run instead of the newest; repeat it for several."
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Export only this robot."),
    ] = None,
    without_images: Annotated[
        bool, typer.Option("--without-images", help="Leave the images out of a ROS 2 bag.")
    ] = False,
    frame_rate: Annotated[float, typer.Option(metavar="HZ", help="Frames per second of a video.")] = 25.0,
    size: Annotated[
        str, typer.Option(metavar="WIDTHxHEIGHT", help="Size of a video in pixels, two even numbers.")
    ] = "1280x720",
) -> None:
    """Export positions, images or another channel to a file for other programs.

    A table has one row for each robot and instant; units are in the names of the columns, times are in UTC. A
    ROS 2 bag has images, intrinsics, poses, odometry and transforms. A video shows the cameras with their
    markers, and the robots on the floor. A COCO data set has the images and the corners of their markers.
    """
    from ipsys_log import api
    from ipsys_log.log_export import find_format, parse_size
    from ipsys_log.report.files import check_file

    wanted = find_format(output, format_)
    if wanted.suffix is not None:
        check_file(output, "-o", logs)
    with api.open(*logs) as log, progress_bar(_COUNTED) as progress:
        exported = log.export(
            output,
            table,
            run,
            robot,
            format=format_,
            with_images=not without_images,
            rate_hz=frame_rate,
            size_px=parse_size(size),
            progress=progress,
        )
    console.print(
        f"{output} written: {exported.rows} {exported.content}"
        + (f", run {' and '.join(exported.runs)}" if exported.runs else "")
    )
