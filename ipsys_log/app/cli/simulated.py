"""The simulated lab: ``ipsys simulate`` renders a session, ``ipsys drive`` lets robots drive in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ipsys_log.app.cli import options as cli
from ipsys_log.app.cli.console import console, print_result, progress_bar, say
from ipsys_log.app.cli.open_cameras import MODEL, check_target
from ipsys_log.app.cli.options import other_log_option, setting, switch
from ipsys_log.app.cli.signals import allow_interrupt, runs_until_stopped, say_kept, stop_on_signal
from ipsys_log.plain_text import shell_words

if TYPE_CHECKING:
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.robot_runs.settings import RobotRun

Paths = Annotated[
    list[str] | None,
    setting("--path", "ROBOT=X,Y...", 'Waypoints of a robot in m: "robot_0=0.5,0.5 0.5,2.5 2,2".'),
]
Failures = Annotated[
    list[str] | None,
    setting("--fail", "CAMERA=START:SECONDS", "Let a camera fail: white=20:5 is at 20 s, for 5 s."),
]


def simulate(
    output: cli.NewLog,
    cameras: Annotated[
        str | None,
        setting(
            "--cameras",
            "GRID",
            "Columns x rows of the cameras of a hall, such as 6x4. Default: a lab with three cameras.",
        ),
    ] = None,
    seed: Annotated[
        int | None, setting("--seed", "N", "Seed of the random numbers. The same seed gives the same bytes.")
    ] = None,
    settings: Annotated[
        Path | None, setting("--settings", "FILE", "Read settings from a TOML file; docs/data.md lists them.")
    ] = None,
    changes: Annotated[
        list[str] | None,
        setting("--set", "NAME=VALUE", "Change a setting, such as drive_s=4; repeat it for several."),
    ] = None,
) -> None:
    """Render a simulated lab with ground truth: calibration points, then a drive of the robots.

    The default is the lab of the paper: three cameras about 2.1 m above a floor of 4.88 m. With --cameras
    6x4, it is a hall: 24 cameras, 5 m above a floor of 20 x 15 m.

    Examples

        ipsys simulate -o lab.mcap
        ipsys simulate -o lab.mcap --set stations=25 --set drive_s=4
        ipsys simulate -o hall.mcap --cameras 6x4 --settings hall.toml
    """
    from ipsys_log.capture.simulation import lab
    from ipsys_log.capture.simulation.settings import LabSettings, hall_settings, parse_grid, read_settings
    from ipsys_log.engine.output import write_log

    given = read_settings(settings, changes or ()) | ({} if seed is None else {"seed": seed})
    chosen = LabSettings(**given) if cameras is None else hall_settings(*parse_grid(cameras), **given)
    text = f"{output} was not written: the log of a simulated lab is written completely or not at all"
    with say_kept(lambda _: text), progress_bar(frame_steps=("simulate",)) as progress:
        counts = write_log(output, lab.simulate(chosen, progress))
    frames = sum(count for topic, count in counts.items() if topic.endswith("/image"))
    console.print(f"{output} written: {frames} frames, {counts.get('/measurements', 0)} calibration points")


@runs_until_stopped
def drive(
    output: cli.NewLog,
    model_from: Annotated[
        cli.OneLog,
        other_log_option(
            "--model-from", help="The log of the simulated lab with the model, a file or a URL."
        ),
    ],
    model: cli.FittedModels = None,
    robots: Annotated[int, switch("--robots", "Number of robots, 1 to 3; their paths cross.")] = 1,
    path: Paths = None,
    program: Annotated[
        Path | None,
        setting("--program", "FILE", "The program of the robots (default: the example of ipsys)."),
    ] = None,
    over: Annotated[str, setting("--over", "udp|vrpn|ros2", "The stream of the positions.")] = "udp",
    loss: Annotated[
        float, setting("--loss", "SHARE", "Lose this share of the datagrams, such as 0.05.")
    ] = 0.0,
    delay_ms: Annotated[float, switch("--delay-ms", "Delay the datagrams, in ms.")] = 0.0,
    fail: Failures = None,
    lockstep: Annotated[
        bool,
        switch("--lockstep", "Use simulated time: the result does not depend on the speed of the machine."),
    ] = False,
    rate_hz: Annotated[float, switch("--rate-hz", "Frames per second of each camera.")] = 5.0,
    seed: Annotated[
        int, switch("--seed", "Seed of the start, the wheels, the noise and the lost datagrams.")
    ] = 0,
    lab_seed: Annotated[int, switch("--lab-seed", "Seed of the simulated lab.")] = 0,
    port: Annotated[
        int, switch("--port", "First of the used ports; 0: free ports.", min=0, max=65000)
    ] = 9870,
    seconds: Annotated[float, switch("--seconds", "Stop after this time.", min=1.0)] = 300.0,
    as_json: cli.AsJson = False,
    force: cli.Force = False,
) -> None:
    """Let robots drive in the simulated lab, each by a program that gets only streamed positions.

    This is the robot experiment of the paper (sect. 4.3). Images are drawn, recorded, processed and streamed
    as by live. The log has the commands of the robots and the ground truth, too.

    Examples

        ipsys drive --model-from cal.mcap -o run.mcap      # robot run of the paper
        ipsys drive --model-from cal.mcap -o run.mcap --model poly --model best
        ipsys drive --model-from cal.mcap -o three.mcap --robots 3 --lockstep
        ipsys drive --model-from cal.mcap -o run.mcap --loss 0.05 --fail white=20:5
    """
    allow_interrupt("stopped before the drive began; no log was written")
    from ipsys_log.capture.simulation.settings import LabSettings
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.robot_runs.settings import (
        PROGRAM,
        RobotRun,
        choose_paths,
        parse_failure,
        read_lab,
    )

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
    from ipsys_log.app.report.robot_run import robot_run_json, robot_run_tables
    from ipsys_log.live_runs.robot_runs.run import drive_robots
    from ipsys_log.log.dataset import Session
    from ipsys_log.tools.robot_run import read_robot_run

    drive_robots(run, output, request, force, say, stop_on_signal)
    with Session([output]) as session:
        result = read_robot_run(session)
    written = f"{output} written; its figure: ipsys report {shell_words(output)}"
    print_result(robot_run_json(result), (robot_run_tables(result), written), as_json)
