"""Stages of the pipeline, in one table: each reads and writes channels. A stage uses no files and no clocks.

The table has the part of each row that the command line needs: name, help and parameters. This module loads
no stage, so that the help of a command appears at once; :mod:`ipsys_log.engine.graph` loads the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ipsys_log.errors import IpsysError

if TYPE_CHECKING:
    from ipsys_log.messages.stage import Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class StageParameter:
    """A parameter of a stage that the user sets, as an option of ``ipsys replay``.

    Attributes
    ----------
    name : as the plan of the stage gets it; the option has dashes instead of underscores.
    help : of the option.
    metavar : name of its value in the help; None for a flag.
    kind, default : type and value of the option.
    least : smallest value of a number.
    choices : the possible values of a method.
    """

    name: str
    help: str
    metavar: str | None = None
    kind: Any = str | None
    default: Any = None
    least: int | None = None
    choices: tuple[str, ...] = ()

    def check(self, value: str) -> None:
        """Check that a value is one of the choices.

        Raises
        ------
        IpsysError
            It is not.
        """
        if value not in self.choices:
            raise IpsysError(f"--{self.name} {value}: is not known; use one of {', '.join(self.choices)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class StageEntry:
    """The entry of a stage: the part of its row that the command line needs.

    Attributes
    ----------
    name : of its row, and for ``ipsys replay --until``. The module with the row has underscores instead of
        dashes.
    help : one sentence.
    parameters : those that its plan reads; later stages have them too.
    """

    name: str
    help: str
    parameters: tuple[StageParameter, ...] = ()

    @property
    def module(self) -> str:
        """Return the name of the module with the row, ``STAGE``, in this package."""
        return self.name.replace("-", "_")


CORNERS = StageParameter(
    name="corners",
    help="Method for corners: edges of the print (edges, the default if all cameras have a calibration), "
    "or the method of the paper (stock).",
    metavar="NAME",
    choices=("edges", "stock"),
)
AS_LIVE = StageParameter(
    name="as_live",
    help="Exclude the frames that were skipped during the recording.",
    kind=bool,
    default=False,
)
SKIP_AMBIGUOUS = StageParameter(
    name="skip_ambiguous",
    help="Exclude a marker from frames that show its id twice.",
    kind=bool,
    default=False,
)
METHOD = StageParameter(
    name="method",
    help="Method for camera points: perimeter (eq. 3 to 5 of the paper, for level markers) or "
    "pose (for tilted markers, too).",
    metavar="NAME",
    kind=str,
    default="perimeter",
    choices=("perimeter", "pose"),
)
MODEL = StageParameter(
    name="model",
    help="Model, such as rigid, poly, best or joint, or a hybrid such as rigid+poly; repeat it for several. "
    "docs/models.md lists all.",
    metavar="NAME",
    kind=list[str] | None,
)
MODEL_FROM = StageParameter(
    name="model_from",
    help="Copy the model of this log, a file or a URL, and apply it.",
    metavar="LOG",
    kind=str | None,
)
TRAIN = StageParameter(
    name="train",
    help="Fit on the measurements with this label.",
    metavar="LABEL",
    kind=str,
    default="train",
)
SEED = StageParameter(
    name="seed",
    help="Seed of random splits, folds and subsets.",
    metavar="N",
    kind=int,
    default=0,
    least=0,
)
SELF_CALIBRATE = StageParameter(
    name="self_calibrate",
    help="Estimate the new pose of a camera that has moved, and use it.",
    kind=bool,
    default=False,
)

# Each stage comes after the stages that write its channels.
ENTRIES: tuple[StageEntry, ...] = (
    StageEntry(
        name="detect",
        help="Detect the markers in the frames.",
        parameters=(CORNERS, AS_LIVE, SKIP_AMBIGUOUS),
    ),
    StageEntry(
        name="camera-frame",
        help="Compute the position of each marker in camera coordinates.",
        parameters=(METHOD,),
    ),
    StageEntry(
        name="fit",
        help="Fit models to the calibration points (default: poly).",
        parameters=(MODEL, MODEL_FROM, TRAIN, SEED),
    ),
    StageEntry(
        name="evaluate",
        help="Evaluate models: their errors, the learning curve and outliers of the measurements.",
    ),
    StageEntry(
        name="watch",
        help="Compare the cameras with one another and with their past (model joint).",
        parameters=(SELF_CALIBRATE,),
    ),
    StageEntry(name="locate", help="Apply a model: compute world positions from each camera."),
    StageEntry(name="fuse", help="Filter the positions of all cameras into one track per robot."),
    StageEntry(name="smooth", help="Smooth the tracks by the sightings before and after each pose."),
)
STAGE_NAMES = tuple(entry.name for entry in ENTRIES)


def load_stage(name: str) -> Stage:
    """Load the row of one stage by its name, without those of the other stages."""
    entry = next(entry for entry in ENTRIES if entry.name == name)
    stage: Stage = import_module(f"ipsys_log.stages.{entry.module}").STAGE
    return stage


def parameters_until(name: str | None) -> list[StageParameter]:
    """Return the parameters of a stage and of those before it, in their order; of all stages for None."""
    names = [entry.name for entry in ENTRIES]
    last = len(names) if name is None else names.index(name) + 1
    return [parameter for entry in ENTRIES[:last] for parameter in entry.parameters]
