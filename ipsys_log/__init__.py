"""Indoor positioning with cheap cameras: everything is a channel in a log.

``import ipsys_log as ipsys`` gives the Python API below; :mod:`ipsys_log.api.python_api` describes it. All
other modules are private until 1.0. The command is ``ipsys``; the pipeline is in
:mod:`ipsys_log.live_runs.pipeline`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ipsys_log.api.log_export import Export
    from ipsys_log.api.opened_log import Listing, Log
    from ipsys_log.api.python_api import (
        FittedModel,
        ModelEvaluation,
        ReplayResult,
        calibrate,
        check,
        live,
        load_model,
        open,
        play,
        replay,
        score,
        verify,
    )
    from ipsys_log.api.sampled_track import SampledTrack
    from ipsys_log.calibration.calibrate import CalibrationResult, Failure
    from ipsys_log.engine.provenance import Outcome
    from ipsys_log.errors import IpsysError
    from ipsys_log.live_runs.player import LiveTracks, Player, Tracker
    from ipsys_log.models.locate_corners import FittedCornerModel
    from ipsys_log.tools.differences import Comparison
    from ipsys_log.tools.publish.scores import Score
    from ipsys_log.tools.publish.scoring import ScoreComparison, ScoreResult
    from ipsys_log.tools.soundness.finding import LogCheck, LogFinding

__all__ = [
    "CalibrationResult",
    "Comparison",
    "Export",
    "Failure",
    "FittedCornerModel",
    "FittedModel",
    "IpsysError",
    "Listing",
    "LiveTracks",
    "Log",
    "LogCheck",
    "LogFinding",
    "ModelEvaluation",
    "Outcome",
    "Player",
    "ReplayResult",
    "SampledTrack",
    "Score",
    "ScoreComparison",
    "ScoreResult",
    "Tracker",
    "calibrate",
    "check",
    "live",
    "load_model",
    "open",
    "play",
    "replay",
    "score",
    "verify",
]

__version__: str


def __getattr__(name: str) -> Any:
    # Each name is looked up when it is used: the command notes signals before the imports, which take long.
    if name == "__version__":
        from importlib.metadata import version

        return version("ipsys_log")
    if name == "IpsysError":
        from ipsys_log.errors import IpsysError

        return IpsysError
    if name == "FittedCornerModel":
        from ipsys_log.models.locate_corners import FittedCornerModel

        return FittedCornerModel
    if name in __all__:
        from ipsys_log.api import python_api

        return getattr(python_api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
