"""Scores of a robot's own estimates against its tracks, as tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ipsys_log.log.dataset import Session
from ipsys_log.statistics.accuracy import root_mean_square_m
from ipsys_log.tools.comparison import Comparison, compare, read_comparisons
from ipsys_log.tools.estimates import CompareOptions

if TYPE_CHECKING:
    import pandas as pd


class ComparedEstimates(NamedTuple):
    """The scores of estimates as pandas tables.

    Attributes
    ----------
    errors : a row for each ATE, by its alignment, and each RPE, by its delta.
    estimates : a row for each estimate: clock, alignment and pivot with their sigmas, coverage, drift, NEES.
    """

    errors: pd.DataFrame
    estimates: pd.DataFrame


def compare_estimates(session: Session, files: Sequence[Path], options: CompareOptions) -> ComparedEstimates:
    """Return the scores of the estimates in files; without files, of those that the log stores.

    Raises
    ------
    IpsysError
        An estimate cannot be read or does not fit the tracks, or pandas is not installed.
    """
    from ipsys_log.exchange.data_frames import import_pandas

    pandas = import_pandas()
    found = compare(session, files, options) if files else read_comparisons(session, options.run)
    return ComparedEstimates(
        pandas.DataFrame([row for one in found for row in _errors(one)]),
        pandas.DataFrame([one.summary() for one in found]),
    )


def _errors(one: Comparison) -> Iterator[dict[str, Any]]:
    for row in one.score.rows():
        names = {"run": one.record.run, "robot": one.robot}
        kind = {"metric": row.metric, "alignment": row.alignment or None, "delta": row.delta or None}
        floor_m = None if row.floor is None else root_mean_square_m(row.floor)
        rest = {"rmse_m": root_mean_square_m(row.space), "rmse_2d_m": floor_m}
        known = {name: value for name, value in asdict(row.space).items() if value is not None}
        yield names | kind | known | rest | {f"{one.score.turn}_rmse_rad": row.rotation_rmse_rad}
