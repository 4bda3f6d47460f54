"""The result of an import of ground truth, as text and as JSON."""

from collections.abc import Iterator
from typing import Any

from ipsys_log.app.report.comparison import alignment_lines
from ipsys_log.app.report.rows import cm, counted, wrap_text
from ipsys_log.exchange.import_truth import TEXTS, ImportedTruth


def truth_lines(imported: ImportedTruth) -> Iterator[str]:
    """Yield the estimates with their standard deviations, and the residuals, for a terminal."""
    poses = ", ".join(f"{count} poses of {robot}" for robot, count in imported.poses.items())
    yield wrap_text(f"Ground truth: {poses}.")
    bodies = {f"{robot}_": f" of {robot}" for robot in imported.poses}
    for line in alignment_lines(imported.record, "the file", bodies):
        yield wrap_text(line)
    if (residuals := imported.residuals) is not None:
        count = residuals.outliers
        outliers = f"; {counted(count, 'outlier')} not used for the estimate" if count else ""
        yield wrap_text(
            f"Residuals against run {imported.tracks_run}: RMSE {cm(residuals.rmse_2d_m)} cm on "
            f"the floor, {cm(residuals.rmse_3d_m)} cm in 3D, at {residuals.instants} instants"
            f"{outliers}."
        )
    if (found := imported.alignment) is not None:
        for remark in found.remarks:
            yield wrap_text(f"Remark: {remark}.")
        what = "offset" if imported.record.parameters["align"] == "none" else "offset and alignment"
        yield wrap_text(
            f"Estimated from these tracks, {what} hide their constant errors: scores show the others only."
        )


def truth_json(imported: ImportedTruth) -> dict[str, Any]:
    """Return the result as plain data, in SI units; the names are those of the record of the run."""
    numbers = {
        name: int(text) if text.isdigit() else float(text)
        for name, text in imported.record.parameters.items()
        if name not in TEXTS
    }
    summary: dict[str, Any] = {
        "log": str(imported.path),
        "run": imported.record.run,
        "poses": imported.poses,
        "align": imported.record.parameters["align"],
    }
    summary |= {
        name: text for name, text in imported.record.parameters.items() if name in ("axes", "remarks")
    }
    compared = {} if imported.tracks_run is None else {"tracks_run": imported.tracks_run}
    return summary | compared | numbers
