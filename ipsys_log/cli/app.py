"""The command ``ipsys``: all commands, their order, and examples."""

from __future__ import annotations

import functools
from collections.abc import Callable
from inspect import cleandoc
from typing import Any

import typer

from ipsys_log.cli import (
    align,
    batch,
    calibrate,
    calibrate_lab,
    cameras,
    catalogue,
    compare,
    contents,
    drift,
    drive,
    export,
    imports,
    inspect,
    log_copies,
    markers,
    measure,
    node,
    plan,
    publish,
    record,
    setup,
    stages,
    stream,
)
from ipsys_log.cli.local_files import needs_local_files
from ipsys_log.cli.signals import interruptible
from ipsys_log.stages import ENTRIES

_STAGES = "Single stages"
# The commands in the order of ``ipsys --help``. A stage without a panel comes into that of the stages.
_PLACED: dict[str, tuple[str, ...]] = {
    "First day, in this order": (
        *("setup", "init", "markers", "cameras", "calibrate", "align", "record", "measure"),
        *("calibrate-lab", "replay", "live"),
    ),
    "Accuracy, and the next points to measure": ("evaluate", "exclude", "plan", "report", "drift"),
    "Inspect a log": (
        *("info", "runs", "check", "du", "cat", "view", "export", "stream"),
        *("cut", "compact", "merge", "verify", "diff", "latency", "repair"),
    ),
    "Many logs": ("batch", "catalogue"),
    "Publish a dataset": ("pack", "score"),
    "Cameras on other hosts": ("node",),
    _STAGES: (),
    "Without cameras": ("simulate", "drive", "import"),
}


def panels() -> dict[str, tuple[str, ...]]:
    """Return the panels with the commands of all stages."""
    placed = {name for names in _PLACED.values() for name in names}
    return {**_PLACED, _STAGES: tuple(entry.name for entry in ENTRIES if entry.name not in placed)}


# Each line is a command and its purpose; at most 76 columns.
EXAMPLES: dict[str, str] = {
    "setup": """
ipsys setup lab                          # all steps of the first day
ipsys setup lab --host 0.0.0.0           # also on a tablet
""",
    "init": """
ipsys init lab.toml                      # an example with comments
ipsys init lab.toml --from monday.mcap   # the rig of a log
ipsys init lab.toml --simulated          # to try all commands
""",
    "markers": """
ipsys markers --rig lab.toml                # all markers of the rig
ipsys markers --ids 0-11 --length 0.08 --page letter
ipsys markers --board 6x4 -o board.pdf      # for ipsys calibrate
""",
    "cameras": """
ipsys cameras                    # the source of each camera
ipsys cameras --rig lab.toml     # is USB fast enough for the rig?
""",
    "calibrate": """
ipsys calibrate photos/red --board 6x4              # a folder: red.yaml
ipsys calibrate --rig lab.toml --board 6x4          # use the cameras now
ipsys calibrate red.mp4 --board charuco:4x5 --camera red --plot red.png
""",
    "align": """
ipsys align --rig lab.toml                     # use the cameras now
ipsys align monday.mcap --plot alignment.png   # of a log, with a figure
""",
    "record": """
ipsys record -o monday.mcap                      # the cameras of lab.toml
ipsys record -o calibration.mcap --measure       # with tape readings
ipsys record -o calibration.mcap --measure --host 0.0.0.0    # on a phone
ipsys record -o short.mcap --camera red --seconds 10
""",
    "measure": """
ipsys measure --rig lab.toml -o cal.mcap --host 0.0.0.0    # on a phone, now
ipsys measure calibration.mcap                     # in a finished log
ipsys measure calibration.mcap --terminal          # in this terminal
ipsys measure calibration.mcap --csv places.csv    # from a sheet
""",
    "calibrate-lab": """
ipsys calibrate-lab drive.mcap cal.mcap --plot floor.png
ipsys calibrate-lab lab.mcap --goal-mm 2           # is 2 mm reached?
ipsys calibrate-lab lab.mcap --field-of-view 105   # without a chessboard
""",
    "replay": """
ipsys replay calibration.mcap                      # fit and evaluate poly
ipsys replay calibration.mcap --model best --plot floor.png
ipsys replay monday.mcap --model-from calibration.mcap
ipsys replay calibration.mcap --rig lab.toml       # with a corrected rig
""",
    "live": """
ipsys live --model-from calibration.mcap -o monday.mcap
ipsys live --model-from calibration.mcap --model best --view -o b.mcap
ipsys live --model-from calibration.mcap -o monday.mcap --udp 9870
ipsys live --model-from calibration.mcap -o monday.mcap --web
""",
    "evaluate": """
ipsys evaluate calibration.mcap                    # all models
ipsys evaluate calibration.mcap --details          # with details
ipsys evaluate calibration.mcap --model poly --model best --plots figures
""",
    "exclude": """
ipsys exclude calibration.mcap p007 p012 --reason "the tape sagged"
ipsys exclude calibration.mcap p012 --readmit --reason "tape was straight"
""",
    "plan": """
ipsys plan calibration.mcap --places 5 --plot next.png
""",
    "report": """
ipsys report calibration.mcap                      # calibration.html
""",
    "drift": """
ipsys drift week*.mcap --plot drift.png            # which camera moved?
ipsys drift week*.mcap --model-from calibration.mcap --rig lab.toml
ipsys drift week*.mcap --fix                       # correct its pose
""",
    "info": """
ipsys info monday.mcap
ipsys info s3://lab/monday.mcap          # at a URL: docs/scale.md
""",
    "check": """
ipsys check monday.mcap                  # is it sound? exit code 0 to 3
ipsys check lab.mcap derived.mcap        # derived.mcap has runs of lab.mcap
ipsys check *.mcap --json                # also notes, for programs
""",
    "du": """
ipsys du monday.mcap
""",
    "cat": """
ipsys cat monday.mcap --topics /events,/latency
ipsys cat monday.mcap --start-offset 10 --end-offset 12 | less
ipsys cat monday.mcap --topics /runs/poly/tracks --json > tracks.ndjson
""",
    "export": """
ipsys export monday.mcap -o tracks.csv
ipsys export monday.mcap -o tracks.parquet --run poly --run best
ipsys export monday.mcap -o robot.tum --robot robot_0    # for evo
ipsys export monday.mcap -o truth.tum --robot robot_0 --table truth
ipsys export monday.mcap -o bag.mcap --format ros2       # with images
ipsys export monday.mcap -o view.mp4 --size 1920x1080
ipsys export monday.mcap -o markers --format coco        # a new folder
""",
    "stream": """
ipsys stream monday.mcap --udp 127.0.0.1:9870 --rate 2
ipsys stream monday.mcap --udp 192.168.1.20:9870 --host 0.0.0.0 --loop
ipsys stream monday.mcap --vrpn --start-offset 20    # port 3883
""",
    "cut": """
ipsys cut monday.mcap -o part.mcap --start 60 --end 90
ipsys cut monday.mcap -o part.mcap --start '2026-05-04 10:00' --camera red
ipsys cut monday.mcap -o small.mcap --exclude-topics '/cameras/*/image'
ipsys cut monday.mcap -o poly.mcap --run poly
""",
    "compact": """
ipsys compact calibration.mcap --dry-run           # which runs, how much?
ipsys compact calibration.mcap -o small.mcap
""",
    "merge": """
ipsys merge monday_a.mcap monday_b.mcap -o monday.mcap
ipsys merge a.mcap b.mcap c.mcap -o day.mcap --offset b=0.012 --offset c=-1
""",
    "verify": """
ipsys verify monday.mcap                           # all of its runs
""",
    "diff": """
ipsys diff monday.mcap tuesday.mcap
ipsys diff monday.mcap --run poly --run best
""",
    "latency": """
ipsys latency monday.mcap --plot latency.pdf
""",
    "repair": """
ipsys repair monday.mcap
""",
    "catalogue": """
ipsys catalogue logs -o catalogue.parquet
ipsys catalogue logs -o catalogue.parquet --baseline logs/first.mcap
""",
    "pack": """
ipsys pack --card-form card.toml                   # write the empty form
ipsys pack calibration.mcap -o dataset/ --card card.toml
ipsys pack calibration.mcap -o small.zip --card card.toml --without-images
""",
    "score": """
ipsys score dataset/                               # exit code 0 or 1
ipsys score small.zip --model mine.py:Estimator    # your own model
""",
    "drive": """
ipsys drive --model-from cal.mcap -o run.mcap      # robot run of the paper
ipsys drive --model-from cal.mcap -o run.mcap --model poly --model best
ipsys drive --model-from cal.mcap -o three.mcap --robots 3 --lockstep
ipsys drive --model-from cal.mcap -o run.mcap --loss 0.05 --fail white=20:5
""",
    "node": """
ipsys node lab.toml --camera red         # on the host of this camera
ipsys node lab.toml --camera red --centre 192.168.1.10:7449
ipsys node lab.toml --camera red --detect     # send only the markers
""",
    "simulate": """
ipsys simulate -o lab.mcap --stations 25 --frames-per-station 2 --drive-s 4
""",
}


def arrange(app: typer.Typer) -> None:
    """Put the commands into their panels, in this order, and the examples below their help."""
    order = [name for names in panels().values() for name in names]
    panel_of = {name: panel for panel, names in panels().items() for name in names}
    for command in app.registered_commands:
        assert command.callback is not None
        command.name = command.name or command.callback.__name__
        command.rich_help_panel = panel_of[command.name]
        command.help = _unwrapped(command.help or command.callback.__doc__ or "")
        if command.name in EXAMPLES:
            lines = EXAMPLES[command.name].strip().splitlines()
            command.epilog = "Examples\n\n" + "\n".join(f"    {line}" for line in lines)
    app.registered_commands.sort(key=lambda command: order.index(str(command.name)))
    for group in app.registered_groups:
        group.rich_help_panel = panel_of[str(group.name)]
        for command in group.typer_instance.registered_commands if group.typer_instance else ():
            assert command.callback is not None
            command.help = _unwrapped(command.help or command.callback.__doc__ or "")


def _unwrapped(text: str) -> str:
    """Return a help text with one line for each paragraph: the terminal wraps them."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in cleandoc(text).split("\n\n"))


def _with_one_reading(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command: it parses the summary of each log once."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> Any:
        from ipsys_log.log.known_contents import one_reading

        with one_reading():
            return command(*arguments, **options)

    return run


app = typer.Typer(
    name="ipsys",
    help="Find the positions of robots indoors, with cheap cameras and ArUco markers. An MCAP log has all "
    "data: replay the log, compare models, view the results.",
    epilog="The help of a command ends with examples: ipsys record --help. To try all commands without a "
    "camera: ipsys init lab.toml --simulated. docs/glossary.md explains the terms.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_MODULES = (
    *(setup, markers, cameras, calibrate, align, imports, record, measure),
    *(calibrate_lab, stages),
    *(plan, drift, inspect, contents, export, stream, log_copies, compare, publish, drive),
    *(batch, catalogue, node),
)
for module in _MODULES:
    module.add_commands(app)
arrange(app)
for typer_app in (app, *(group.typer_instance for group in app.registered_groups)):
    for command in typer_app.registered_commands if typer_app else ():
        if command.callback is not None:
            command.callback = interruptible(needs_local_files(_with_one_reading(command.callback)))


def _print_version(wanted: bool) -> None:
    if wanted:
        from ipsys_log import __version__

        typer.echo(f"ipsys {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Options of ``ipsys`` itself; the help is that of the application."""
