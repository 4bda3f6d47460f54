"""The calibration points of a log: their measurements, observations, and the split into training and test."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from ipsys_log.messages import Measurement, Pair
from ipsys_log.messages.channels import CAMERA_POINTS, MEASUREMENTS, RIG
from ipsys_log.messages.stage import StageView
from ipsys_log.statistics.pairs import (
    build_pairs,
    gather_sightings,
    split,
    valid_measurements,
    withdrawals,
)
from ipsys_log.statistics.tape import RiggedMeasurement


def measured(view: StageView) -> list[RiggedMeasurement]:
    """Return the valid measurements, each with the rig in force when it was measured, or with the view's."""
    return valid_measurements(view.messages(RIG, MEASUREMENTS), view.rig)


def find_pairs(view: StageView, points: list[RiggedMeasurement]) -> dict[str, list[Pair]]:
    """Return the observations of the calibration points by camera."""
    return build_pairs(gather_sightings(view.messages(CAMERA_POINTS)), points)


def training_pairs(view: StageView, train: Collection[str]) -> dict[str, list[Pair]]:
    """Return the observations of some calibration points by camera."""
    pairs = find_pairs(view, measured(view))
    return {camera: [pair for pair in seen if pair.measurement in train] for camera, seen in pairs.items()}


def has_measurements(view: StageView) -> bool:
    """Return whether a measurement was entered and not withdrawn."""
    entered: list[Measurement] = view.payloads(MEASUREMENTS)
    withdrawn = withdrawals(entered)
    return any(m.is_point and m.id not in withdrawn for m in entered)


def split_ids(measurements: Iterable[Measurement], options: Mapping[str, str]) -> tuple[set[str], set[str]]:
    """Return the ids of the measurements to fit on, and of those to test on."""
    return split(list(measurements), options.get("train", "train"), int(options.get("seed", "0")))


def held_out_ids(measurements: Iterable[Measurement], options: Mapping[str, str]) -> set[str]:
    """Return the ids of the measurements that models are evaluated on."""
    measurements = list(measurements)
    if "model_from" not in options:
        return split_ids(measurements, options)[1] if measurements else set()
    # A model of another log was not fitted to these points; if it was, evaluate_model notices it.
    labelled = any(m.splits for m in measurements)
    return {m.id for m in measurements if "test" in m.splits or not labelled}


def split_parameters(view: StageView, options: Mapping[str, str]) -> dict[str, str]:
    """Return the parameters of the split: the label, or the seed if nothing is labelled."""
    labelled = any(m.splits for m in view.payloads(MEASUREMENTS))
    return {"train": options.get("train", "train")} if labelled else {"seed": options.get("seed", "0")}
