"""Robots in the simulated lab, each controlled by a program of its own: ``ipsys drive``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ipsys_log.cli.console import console, print_json, say
from ipsys_log.cli.open_cameras import MODEL, check_target
from ipsys_log.cli.options import AsJson, Force, NewLog, OneLog, other_log_option
from ipsys_log.cli.signals import allow_interrupt, runs_until_stopped, stop_on_signal
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.closed_loop.settings import RobotRun
    from ipsys_log.runs.options import Request

Models = Annotated[
    list[str] | None,
    typer.Option(
        "--model",
        metavar="NAME",
        help="Model of this log, such as best; repeat it to compare several. The robots get the positions of "
        "the first. Default: poly, if the log has it.",
    ),
]
Paths = Annotated[
    list[str] | None,
    typer.Option(
        "--path", metavar="ROBOT=X,Y...", help='Waypoints of a robot in m: "robot_0=0.5,0.5 0.5,2.5 2,2".'
    ),
]
Failures = Annotated[
    list[str] | None,
    typer.Option(
        "--fail", metavar="CAMERA=START:SECONDS", help="Let a camera fail: white=20:5 is at 20 s, for 5 s."
    ),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(drive)


@runs_until_stopped
def drive(
    output: NewLog,
    model_from: Annotated[
        OneLog,
        other_log_option(
            "--model-from", help="The log of the simulated lab with the model, a file or a URL."
        ),
    ],
    model: Models = None,
    robots: Annotated[int, typer.Option("--robots", help="Number of robots, 1 to 3; their paths cross.")] = 1,
    path: Paths = None,
    program: Annotated[
        Path | None,
        typer.Option(
            "--program", metavar="FILE", help="The program of the robots (default: the example of ipsys)."
        ),
    ] = None,
    over: Annotated[
        str, typer.Option("--over", metavar="udp|vrpn|ros2", help="The stream of the positions.")
    ] = "udp",
    loss: Annotated[
        float, typer.Option("--loss", metavar="SHARE", help="Lose this share of the datagrams, such as 0.05.")
    ] = 0.0,
    delay_ms: Annotated[float, typer.Option("--delay-ms", help="Delay the datagrams, in ms.")] = 0.0,
    fail: Failures = None,
    lockstep: Annotated[
        bool,
        typer.Option(
            "--lockstep", help="Use simulated time: the result does not depend on the speed of the machine."
        ),
    ] = False,
    rate_hz: Annotated[float, typer.Option("--rate-hz", help="Frames per second of each camera.")] = 5.0,
    seed: Annotated[
        int, typer.Option("--seed", help="Seed of the start, the wheels, the noise and the lost datagrams.")
    ] = 0,
    lab_seed: Annotated[int, typer.Option("--lab-seed", help="Seed of the simulated lab.")] = 0,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65000, help="First of the used ports; 0: free ports.")
    ] = 9870,
    seconds: Annotated[float, typer.Option("--seconds", min=1.0, help="Stop after this time.")] = 300.0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Let robots drive in the simulated lab, each by a program that gets only streamed positions.

    This is the robot experiment of the paper (sect. 4.3). Images are drawn, recorded, processed and streamed
    as by live. The log has the commands of the robots and the ground truth, too."""
    allow_interrupt("stopped before the drive began; no log was written")
    from ipsys_log.closed_loop.settings import PROGRAM, RobotRun, choose_paths, parse_failure, read_lab
    from ipsys_log.runs.options import Request
    from ipsys_log.simulation.settings import LabSettings

    check_target(output, force, [(MODEL, model_from)])
    run = RobotRun(
        read_lab(model_from, LabSettings(seed=lab_seed, markers=max(robots, 1), rate_hz=rate_hz)),
        choose_paths(robots, path or ()),
        program or PROGRAM,
        over,
        loss,
        delay_ms / 1000,
        tuple(map(parse_failure, fail or ())),
        lockstep,
        seed,
        port,
        longest_s=seconds,
    )
    run.check()
    request = Request(models=tuple(dict.fromkeys(model or ())), model_from=model_from)
    _drive(run, output, request, force, as_json)


def _drive(run: RobotRun, output: Path, request: Request, force: bool, as_json: bool) -> None:
    from ipsys_log.analysis.robot_run import read_robot_run
    from ipsys_log.closed_loop.run import drive_robots
    from ipsys_log.log.dataset import Session
    from ipsys_log.report.robot_run import robot_run_json, robot_run_tables

    drive_robots(run, output, request, force, say, stop_on_signal)
    with Session([output]) as session:
        result = read_robot_run(session)
    if as_json:
        print_json(robot_run_json(result))
        return
    console.print(robot_run_tables(result))
    console.print(f"{output} written; its figure: ipsys report {shell_words(output)}")
