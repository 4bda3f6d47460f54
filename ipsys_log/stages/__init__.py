"""Stages of the pipeline, in one table: each reads and writes channels. A stage uses no files and no clocks.

The table has the part of each row that the command line needs: name, help and parameters. This module loads
no stage, so that the help of a command appears at once; :mod:`ipsys_log.runs.graph` loads the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["CORNERS", "ENTRIES", "METHOD", "Entry", "Parameter", "parameters_until"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """A parameter of a stage that the user sets, as an option of its command and of those of later stages.

    Attributes
    ----------
    name : as the plan of the stage gets it; the option has dashes instead of underscores.
    help : of the option.
    metavar : name of its value in the help; None for a flag.
    kind, default : type and value of the option.
    least : smallest value of a number.
    """

    name: str
    help: str
    metavar: str | None = None
    kind: Any = str | None
    default: Any = None
    least: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """The entry of a stage: the part of its row that the command line needs.

    Attributes
    ----------
    name : of its command and of its row. The module with the row has underscores instead of dashes.
    help : of its command.
    parameters : those that its plan reads; later stages have them too.
    prints : names of further options of its command, about its printed result.
    """

    name: str
    help: str
    parameters: tuple[Parameter, ...] = ()
    prints: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        """Return the name of the module with the row, ``STAGE``."""
        return f"{__name__}.{self.name.replace('-', '_')}"


CORNERS = Parameter(
    name="corners",
    help="Find corners by the edges of the print (edges; the default if all cameras have a calibration), or "
    "as the paper does (stock).",
    metavar="NAME",
)
AS_LIVE = Parameter(
    name="as_live",
    help="Pass over the frames that were skipped when the log was recorded.",
    kind=bool,
    default=False,
)
SKIP_AMBIGUOUS = Parameter(
    name="skip_ambiguous",
    help="Leave out a marker in frames that show its id twice.",
    kind=bool,
    default=False,
)
METHOD = Parameter(
    name="method",
    help="How markers are placed: by their perimeter (eq. 3 to 5 of the paper; for level ones), or by their "
    "pose (tilted ones too).",
    metavar="NAME",
    kind=str,
    default="perimeter",
)
MODEL = Parameter(
    name="model",
    help="rigid, poly, ann, kriging, kriging-regression, rigid+ and the name of one of these, rayplane, "
    "best; repeat it for several.",
    metavar="NAME",
    kind=list[str] | None,
)
MODEL_FROM = Parameter(
    name="model_from",
    help="Apply the model of another log; copy it in.",
    metavar="LOG",
    kind=Path | None,
)
TRAIN = Parameter(
    name="train",
    help="Fit on the measurements with this label.",
    metavar="LABEL",
    kind=str,
    default="train",
)
SEED = Parameter(
    name="seed",
    help="The seed of random splits, folds and subsets.",
    metavar="N",
    kind=int,
    default=0,
    least=0,
)

# Each stage comes after the stages that write its channels.
ENTRIES: tuple[Entry, ...] = (
    Entry(
        name="detect",
        help="Find the markers in the frames.",
        parameters=(CORNERS, AS_LIVE, SKIP_AMBIGUOUS),
    ),
    Entry(
        name="camera-frame",
        help="Put the markers into the frame of their camera.",
        parameters=(METHOD,),
    ),
    Entry(
        name="fit",
        help="Fit models to the measured places (poly, unless you say which).",
        parameters=(MODEL, MODEL_FROM, TRAIN, SEED),
    ),
    Entry(
        name="evaluate",
        help="Say how far models are off, how many places are enough, and which look wrongly measured.\n\n"
        "For all models, unless you say which; on places held out, and by cross-validation, which takes each "
        "part of the places in turn.",
        prints=("plots", "details"),
    ),
    Entry(name="locate", help="Apply a model: world positions for each camera."),
    Entry(name="fuse", help="One pose per robot from all cameras that see it."),
)


def parameters_until(name: str | None) -> list[Parameter]:
    """Return the parameters of a stage and of those before it, in their order; of all stages for None."""
    names = [entry.name for entry in ENTRIES]
    last = len(names) if name is None else names.index(name) + 1
    return [parameter for entry in ENTRIES[:last] for parameter in entry.parameters]
