"""The table of cases: typed commands and their input files.

A case runs in a separate folder with copies of its inputs. Afterwards, all files in the folder and the
output of each command with ``--json`` are compared.
"""

from collections.abc import Iterator
from dataclasses import dataclass

MODELS = (
    *("rigid", "poly", "ann", "kriging", "kriging-regression"),
    *("rigid+poly", "rigid+ann", "rigid+kriging", "rigid+kriging-regression", "rayplane", "best"),
)


@dataclass(frozen=True, slots=True)
class Step:
    """A command: its words, the use of the scripted clock, and the valid exit codes."""

    arguments: tuple[str, ...]
    scripted: bool = False
    codes: tuple[int, ...] = (0,)


@dataclass(frozen=True, slots=True)
class Case:
    """Commands in one folder.

    Attributes
    ----------
    inputs : files and folders that are copied there; :mod:`tests.same_bytes.inputs` makes them.
    messages_only : of the logs only the messages are compared, each topic in the order of its log times.
    """

    name: str
    inputs: tuple[str, ...]
    steps: tuple[Step, ...]
    messages_only: bool = False


def ipsys(text: str, scripted: bool = False, codes: tuple[int, ...] = (0,)) -> Step:
    """Return a step; ``{models}`` stands for the options of all models."""
    models = " ".join(f"--model {model}" for model in MODELS)
    return Step(tuple(text.replace("{models}", models).split()), scripted, codes)


def _stages() -> Iterator[Case]:
    yield Case(
        "single-stages",
        ("lab.mcap",),
        tuple(
            ipsys(f"{command} lab.mcap --json")
            for command in ("detect", "camera-frame", "fit", "evaluate --model poly", "locate", "fuse")
        ),
    )
    for corners in ("edges", "stock"):
        for method in ("perimeter", "pose"):
            chosen = f"--corners {corners} --method {method}"
            yield Case(
                f"models-{corners}-{method}",
                ("lab.mcap",),
                (
                    ipsys(f"locate lab.mcap {{models}} {chosen} --json"),
                    ipsys(f"replay lab.mcap --model poly --model rayplane {chosen} --json"),
                ),
            )
    yield Case(
        "models-of-another-log",
        ("lab.mcap", "fitted.mcap"),
        (ipsys("replay lab.mcap --model-from fitted.mcap {models} -o out.mcap --json"),),
    )
    yield Case("evaluate-all-models", ("lab.mcap",), (ipsys("evaluate lab.mcap --details --json"),))
    yield Case(
        "options",
        ("paper_lab.mcap", "lab.toml"),
        (
            ipsys("fit paper_lab.mcap --model best --seed 3 --json"),
            ipsys("fit paper_lab.mcap --train other --json", codes=(1,)),
            ipsys("locate paper_lab.mcap --model best --rig lab.toml --json"),
            ipsys("locate paper_lab.mcap --model poly --skip-ambiguous -o apart.mcap --json"),
            ipsys("runs paper_lab.mcap --json"),
        ),
    )


def _samples() -> Iterator[Case]:
    yield Case(
        "replay-small-lab",
        ("small_lab.mcap",),
        (
            ipsys("replay small_lab.mcap --json"),
            ipsys("replay small_lab.mcap --json"),
            ipsys("info small_lab.mcap --json"),
            ipsys("runs small_lab.mcap --json"),
        ),
    )
    yield Case(
        "replay-paper-lab",
        ("paper_lab.mcap",),
        (ipsys("replay paper_lab.mcap --model best --json"), ipsys("info paper_lab.mcap --json")),
    )
    yield Case("plan-paper-lab", ("paper_lab.mcap",), (ipsys("plan paper_lab.mcap --places 3 --json"),))
    yield Case(
        "golden-v0-1-0",
        ("v0_1_0.mcap",),
        (
            ipsys("info v0_1_0.mcap --json"),
            ipsys("runs v0_1_0.mcap --json"),
            ipsys("replay v0_1_0.mcap --json"),
            ipsys("replay v0_1_0.mcap --run again -o again.mcap --json"),
            ipsys("diff v0_1_0.mcap --run poly --run best --json", codes=(1,)),
        ),
    )


def _made() -> Iterator[Case]:
    small = "--width 640 --height 360 --markers 4 --stations 8 --frames-per-station 1"
    yield Case(
        "simulate",
        (),
        (
            ipsys(f"simulate -o lab.mcap --seed 1 {small} --rate-hz 5 --drive-s 1"),
            ipsys(f"simulate -o rolling.mcap {small} --row-time-ns 31000 --exposure-s 0.01 --drive-s 0.2"),
        ),
    )
    yield Case(
        "import-images",
        ("pictures", "lab.toml", "lab.mcap"),
        (
            ipsys("import images pictures -o plain.mcap --rate 5"),
            ipsys("import images pictures -o images.mcap --rig lab.toml --calibration lab.mcap"),
            ipsys("detect images.mcap --json"),
        ),
    )
    yield Case(
        "import-videos",
        ("red.mp4", "lab.toml", "lab.mcap"),
        (
            ipsys("import videos red=red.mp4 -o video.mcap --rig lab.toml --calibration lab.mcap"),
            ipsys("detect video.mcap --json"),
        ),
    )
    yield Case("import-imsel", ("imsel",), (ipsys("import imsel imsel -o imsel.mcap"),))
    yield Case("calibrate", ("board",), (ipsys("calibrate board --board 6x4 --json -o ."),))
    yield Case(
        "align",
        ("small_lab.mcap", "paper_lab.mcap"),
        (ipsys("align paper_lab.mcap --json"), ipsys("align small_lab.mcap -o align.mcap --json")),
    )
    yield Case(
        "measure-sheet",
        ("unmeasured.mcap", "sheet.csv"),
        (
            ipsys("measure unmeasured.mcap --places --json"),
            ipsys("measure unmeasured.mcap --csv sheet.csv --force --json"),
            ipsys("fit unmeasured.mcap --json"),
        ),
    )
    yield Case("cameras", ("live.toml", "lab.mcap"), (ipsys("cameras --rig live.toml --json"),))
    yield Case("rig-of-a-log", ("lab.mcap",), (ipsys("init rig.toml --from lab.mcap"),))


def _damaged() -> Iterator[Case]:
    for name in ("no-end", "cut", "flipped", "cut-live"):
        yield Case(
            f"repair-{name}",
            (f"{name}.mcap",),
            (ipsys(f"repair {name}.mcap"), ipsys(f"info {name}.mcap --json")),
        )


def _live() -> Iterator[Case]:
    start = "--rig live.toml --calibration lab.mcap"
    inputs = ("lab.mcap", "live.toml")
    yield Case("record", inputs, (ipsys(f"record {start} -o out.mcap", scripted=True),), True)
    yield Case("record-detect", inputs, (ipsys(f"record {start} --detect -o out.mcap", scripted=True),), True)
    yield Case(
        "live",
        (*inputs, "fitted.mcap"),
        (
            ipsys(f"live {start} --model-from fitted.mcap --model poly -o poly.mcap", scripted=True),
            ipsys(
                f"live {start} --model-from fitted.mcap --model rayplane --method pose -o pose.mcap",
                scripted=True,
            ),
        ),
        True,
    )
    yield Case("align-now", inputs, (ipsys(f"align {start} --json --seconds 600", scripted=True),), True)
    yield Case(
        "after-live",
        ("live.mcap", "fitted.mcap"),
        (
            ipsys("verify live.mcap --json"),
            ipsys("latency live.mcap --json"),
            ipsys("replay live.mcap --as-live --model-from fitted.mcap --json"),
        ),
    )


CASES = (*_made(), *_samples(), *_stages(), *_damaged(), *_live())


def case_names() -> list[str]:
    return [case.name for case in CASES]
