"""Scores of a dataset: the answer of a re-scoring, its table, and plain data."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from rich.console import Group
from rich.text import Text

from ipsys_log.app.report.advice import label
from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, counted, name_cell, wrap_text
from ipsys_log.app.report.tables import height_note
from ipsys_log.plain_text import shell_words
from ipsys_log.statistics.accuracy import CROSS_VALIDATION
from ipsys_log.tools.publish.packing import PackResult
from ipsys_log.tools.publish.scores import Score
from ipsys_log.tools.publish.scoring import ScoreComparison, ScoreResult
from ipsys_log.units import MM_PER_M, format_bytes

_HEADS = ("mean", "median", "p95", "RMSE")
_NAMED = 3  # differences that the answer names


def pack_text(result: PackResult) -> str:
    """Return the summary of a pack that was written."""
    models = len({score.model for score in result.scores})
    return wrap_text(
        f"{result.path} written: {len(result.files)} files, {format_bytes(result.size)}, expected scores of "
        f"{counted(models, 'model')}. To check it: "
        f"ipsys score {shell_words(result.path)}"
    )


def score_answer(result: ScoreResult) -> Group:
    """Return the answer in sentences: the comparison with the stated scores, and the rank of own models."""
    lines = [*_comparison_lines(result), *_own_lines(result)]
    return Group(*(Text(wrap_text(line), style="bold" if not n else "") for n, line in enumerate(lines)))


def _comparison_lines(result: ScoreResult) -> Iterator[str]:
    wrong = [comparison for comparison in result.comparisons if not comparison.as_stated]
    if not result.comparisons:
        return
    models = len({comparison.stated.model for comparison in result.comparisons})
    named = counted(models, "model")
    title = name_cell(result.title).plain
    if not wrong:
        largest_mm = max(comparison.difference_mm or 0.0 for comparison in result.comparisons)
        yield f"{title}: the scores of {named} come out as stated. Largest difference: {_mm(largest_mm)} mm."
    else:
        yield (
            f"{title}: {len(wrong)} of {len(result.comparisons)} scores of {named} do not come out as stated."
        )
        yield from (f"{_describe(comparison)}." for comparison in wrong[:_NAMED])
    if result.other_versions:
        yield f"The pack was scored with other versions of {', '.join(result.other_versions)}."


def _describe(comparison: ScoreComparison) -> str:
    stated, computed = comparison.stated, comparison.computed
    what = f"{stated.model} ({_kind(stated)})"
    if computed is None:
        return f"{what}: the model cannot be evaluated here"
    if computed.points != stated.points:
        return f"{what}: {computed.points} points, stated are {stated.points}"
    pairs = zip(_HEADS, computed.figures, stated.figures, strict=True)
    head, here_mm, stated_mm = max(pairs, key=lambda pair: abs(pair[1] - pair[2]))
    return (
        f"{what}: {head} {_mm(here_mm)} mm, stated is {_mm(stated_mm)} mm; the tolerance is "
        f"{_mm(stated.tolerance_mm)} mm"
    )


def _kind(score: Score) -> str:
    scheme = "cross-validated" if score.scheme == CROSS_VALIDATION else "held out"
    against = ", against the ground truth" if score.against == "truth" else ""
    return f"{score.dimensions.upper()}, {scheme}{against}"


def _mm(value_mm: float | None) -> str:
    if value_mm is None:
        return "-"
    return f"{value_mm:.0f}" if value_mm >= 1e4 else f"{value_mm:.3f}" if value_mm else "0"


def _own_lines(result: ScoreResult) -> Iterator[str]:
    names = dict.fromkeys(score.model for score in result.own)
    ranked = ranked_scores((*result.stated, *result.own))
    for name in names:
        place, score = next((n, one) for n, one in enumerate(ranked, 1) if one.model == name)
        yield (
            f"{name}: mean error {_mm(score.mean_mm)} mm, RMSE {_mm(score.rmse_mm)} mm ({_kind(score)}). "
            f"Rank {place} of {len(ranked)} models."
        )


def ranked_scores(scores: Iterable[Score]) -> list[Score]:
    """Return one score of each model, the lowest mean first.

    The scores are those against the tape: cross-validated and in space, if all models have them.
    """
    rows = [score for score in scores if score.against == "tape"]
    models = {score.model for score in rows}
    for scheme, dimensions in (
        *((CROSS_VALIDATION, "3d"), (CROSS_VALIDATION, "2d")),
        *(("held_out", "3d"), ("held_out", "2d")),
    ):
        same = [score for score in rows if (score.scheme, score.dimensions) == (scheme, dimensions)]
        if {score.model for score in same} == models:
            return sorted(same, key=lambda score: score.mean_mm)
    return sorted(rows, key=lambda score: score.mean_mm)


def score_tables(result: ScoreResult) -> Iterator[Rows]:
    """Yield the table of a re-scoring: a row for each model, within 80 columns."""
    if result.comparisons:
        yield _comparison_table(result.comparisons)
    if result.own:
        yield _own_table(result)


def _comparison_table(comparisons: Sequence[ScoreComparison]) -> Rows:
    """Return the repeated errors of each model, and the largest difference of all its figures."""
    ranked = ranked_scores(comparison.stated for comparison in comparisons)
    by_key = {comparison.stated.key: comparison for comparison in comparisons}
    cells = []
    for stated in ranked:
        own = [comparison for comparison in comparisons if comparison.stated.model == stated.model]
        computed = by_key[stated.key].computed
        differences = [comparison.difference_mm for comparison in own]
        known = [value_mm for value_mm in differences if value_mm is not None]
        cells.append(
            [
                label(stated.model),
                *(["-"] * len(_HEADS) if computed is None else map(_two, computed.figures)),
                _mm(max(known)) if len(known) == len(differences) else "-",
                f"{stated.tolerance_mm:g}",
                "yes" if all(comparison.as_stated for comparison in own) else "no",
            ]
        )
    title = f"Errors in mm, {_kind(ranked[0])}" if ranked else "Errors in mm"
    columns = ("model", *(f">{head}" for head in (*_HEADS, "difference", "tolerance", "agrees")))
    note = f"{_CAPTION}\n{height_note(score.model for score in ranked)}"
    return Rows(title, columns, cells, note)


_CAPTION = "difference: the largest of all scores of a model, also held out and in 2D"


def _own_table(result: ScoreResult) -> Rows:
    """Return the errors of the user's models beside the stated ones, the lowest mean first."""
    ranked = ranked_scores((*result.stated, *result.own))
    own = {score.model for score in result.own}
    cells = []
    for score in ranked:
        source = "computed" if score.model in own else "as stated"
        cells.append([label(score.model), str(score.points), *map(_two, score.figures), source])
    columns = ("model", *(f">{head}" for head in ("points", *_HEADS, "source")))
    note = height_note(score.model for score in ranked)
    return Rows(f"Errors in mm, {_kind(ranked[0])}", columns, cells, note)


def _two(value_mm: float) -> str:
    return f"{value_mm:.2f}" if value_mm < 1e4 else f"{value_mm:.0f}"


def score_json(result: ScoreResult) -> dict[str, Any]:
    """Return the result of a re-scoring as plain data, in m."""
    comparisons = [
        {
            "stated": comparison.stated,
            "computed": comparison.computed,
            "difference_mm": comparison.difference_mm,
            "as_stated": comparison.as_stated,
        }
        for comparison in result.comparisons
    ]
    return {
        "title": result.title,
        "as_stated": result.as_stated,
        "comparisons": _in_m(plain(comparisons)),
        "own": _in_m(plain(result.own)),
        "other_versions": list(result.other_versions),
    }


def _in_m(value: Any) -> Any:
    """Return plain data with lengths in m instead of mm."""
    if isinstance(value, list):
        return [_in_m(part) for part in value]
    if not isinstance(value, dict):
        return value
    lengths = {f"{key[:-3]}_m": part / MM_PER_M for key, part in value.items() if key.endswith("_mm")}
    return {key: _in_m(part) for key, part in value.items() if not key.endswith("_mm")} | lengths
