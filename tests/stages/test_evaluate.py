"""Errors by eq. (26) and (27) at held-out points and by cross-validation; learning curves; covariances."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from ipsys_log.errors import FitError
from ipsys_log.messages import Distance, Evaluation, Measurement, Message, Pair, Track, Tracks
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import AppliedModel, fit_cameras, group_dependent_cameras, min_pairs
from ipsys_log.statistics.accuracy import (
    POOLED,
    error_statistics,
    evaluate_cross_validated,
    evaluate_held_out,
)
from ipsys_log.statistics.camera_models import describe_camera_models, fit_model, height_sigmas
from ipsys_log.statistics.cross_validation import (
    FOLDS,
    Study,
    gather_points,
    labelled_subsets,
    learning_curve,
    leave_one_out,
    make_folds,
    predict_without,
    published_curve,
)
from ipsys_log.statistics.ground_truth import gather_tracks, track_errors
from ipsys_log.statistics.model_kinds import evaluate_model
from ipsys_log.statistics.tape import RiggedMeasurement, world_point
from tests import labs

POINTS = np.random.default_rng(0).uniform((-2, -1, 1.9), (2, 1, 2.1), (14, 3))


def pairs(offset: np.ndarray) -> list[Pair]:
    return [Pair(f"m{n}", 0, point, point + offset, 1) for n, point in enumerate(POINTS)]


def lab(seed: int, count: int = 40, **noise: float) -> tuple[list[Pair], np.ndarray, np.ndarray]:
    """Return pairs of one camera, and camera points and world points of a drive in the same view."""
    rng = np.random.default_rng(seed)
    camera, world = labs.camera(rng, **noise), labs.places(rng, count)
    tape, covariances = labs.measure(world, rng)
    drive = np.column_stack([rng.uniform(0.4, 4.4, 300), rng.uniform(0.3, 1.5, 300), np.full(300, 0.1)])
    return labs.pairs(camera.see(world, rng), tape, covariances), camera.see(drive, rng), drive


def test_statistics_are_those_of_the_standard_library() -> None:
    errors = [0.01, 0.025, 0.013, 0.07]
    found = error_statistics(np.array(errors))
    assert found.count == 4
    assert found.mean_m == pytest.approx(statistics.mean(errors))
    assert found.median_m == pytest.approx(statistics.median(errors))
    assert found.std_m == pytest.approx(statistics.stdev(errors))
    assert (found.min_m, found.max_m) == (0.01, 0.07)
    single = error_statistics(np.array([0.01]))
    assert (single.std_m, single.mean_low_m) == (None, None)


def test_confidence_interval_contains_the_mean_at_its_rate() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(300):
        found = error_statistics(rng.gamma(2.0, 0.005, 50))
        assert found.mean_low_m is not None
        assert found.mean_high_m is not None
        held += found.mean_low_m <= 0.01 <= found.mean_high_m
    assert 0.90 <= held / 300 <= 0.98


def test_repeats_at_one_point_do_not_narrow_the_interval() -> None:
    errors = np.random.default_rng(1).gamma(2.0, 0.005, 30)
    once, four_times = error_statistics(errors), error_statistics(np.tile(errors, (4, 1)))
    assert four_times.count == 30
    assert (four_times.mean_low_m, four_times.mean_high_m) == pytest.approx(
        (once.mean_low_m, once.mean_high_m), rel=1e-9
    )


def test_two_errors_at_one_point_are_one_draw() -> None:
    errors = np.random.default_rng(1).gamma(2.0, 0.005, 30)
    names = [f"m{n}" for n in range(30)]
    twice = error_statistics(np.r_[errors, errors], points=names * 2)
    assert twice.count == 60
    once, apart = error_statistics(errors), error_statistics(np.r_[errors, errors])
    assert (twice.mean_low_m, twice.mean_high_m) == pytest.approx((once.mean_low_m, once.mean_high_m))
    assert twice.mean_high_m is not None
    assert twice.mean_low_m is not None
    assert apart.mean_high_m is not None
    assert apart.mean_low_m is not None
    assert twice.mean_high_m - twice.mean_low_m > 1.3 * (apart.mean_high_m - apart.mean_low_m)


def test_interval_of_all_cameras_draws_shared_points_once() -> None:
    rng = np.random.default_rng(4)
    model = fit_model("rigid", {"red": pairs(np.zeros(3)), "white": pairs(np.zeros(3))}, 0)
    moved = [replace(p, world_m=p.world_m + rng.normal(0, 0.01, 3)) for p in pairs(np.zeros(3))]
    renamed = [replace(p, measurement=f"w{n}") for n, p in enumerate(moved)]
    tied = [replace(p, calibration_point=f"m{n}") for n, p in enumerate(renamed)]

    def width_m(white: list[Pair]) -> float:
        rows = evaluate_held_out(model, {"red": moved, "white": white}, {})
        found = next(row.error_2d for row in rows if row.camera == POOLED)
        assert found.mean_high_m is not None
        assert found.mean_low_m is not None
        return found.mean_high_m - found.mean_low_m

    assert width_m(moved) == width_m(tied) > 1.2 * width_m(renamed)


def test_errors_in_space_and_on_the_floor() -> None:
    model = fit_model("rigid", {"red": pairs(np.zeros(3))}, 0)
    (row,) = evaluate_held_out(model, {"red": pairs(np.array([0.03, 0.04, 0.12]))}, {})
    assert (row.against, row.scheme) == ("tape", "held_out")
    assert row.error_3d is not None
    assert row.error_3d.mean_m == pytest.approx(0.13)
    assert row.error_2d.mean_m == pytest.approx(0.05)
    assert row.bias_m is not None
    np.testing.assert_allclose(row.bias_m, np.array([-0.03, -0.04, -0.12]))


def test_the_truth_is_compared_where_it_is_known() -> None:
    model = fit_model("rigid", {"red": pairs(np.zeros(3))}, 0)
    truth = {"m0": POINTS[0], "m5": POINTS[5] + [0, 0, 0.01]}
    rows = {row.against: row for row in evaluate_held_out(model, {"red": pairs(np.ones(3))}, truth)}
    assert rows["truth"].error_3d is not None
    assert rows["truth"].error_3d.count == 2
    assert rows["truth"].error_3d.max_m == pytest.approx(0.01)
    assert rows["tape"].error_2d.count == 14


def test_all_cameras_together_are_one_row_more() -> None:
    model = fit_model("rigid", {"red": pairs(np.zeros(3)), "white": pairs(np.zeros(3))}, 0)
    held_out = {"red": pairs(np.array([0.01, 0, 0])), "white": pairs(np.array([0.03, 0, 0]))[:7]}
    rows = {row.camera: row for row in evaluate_held_out(model, held_out, {})}
    assert set(rows) == {"red", "white", POOLED}
    assert rows[POOLED].error_2d.mean_m == pytest.approx((14 * 0.01 + 7 * 0.03) / 21)
    only = evaluate_held_out(model, {"white": pairs(np.ones(3))}, {})
    assert [row.camera for row in only] == ["white"]


def test_points_of_the_fit_are_not_held_out() -> None:
    """A model may be applied to the log of its own calibration points."""
    model = fit_model("rigid", {"red": pairs(np.zeros(3))}, 0)
    assert evaluate_held_out(model, {"red": pairs(np.zeros(3))}, {}) == []


def test_points_at_one_height_have_no_3d_error() -> None:
    rng = np.random.default_rng(0)
    world = labs.places(rng, 20, heights=(0.1,))
    tape, covariances = labs.measure(world, rng)
    tape[:, 2] = 0.1
    model = fit_model("poly", {"red": labs.pairs(labs.camera(rng).see(world, rng), tape, covariances)}, 0)
    rows = evaluate_cross_validated(model, {"red": list(model.cameras[0].pairs)}, {}, 0)
    assert [(row.error_3d, row.error_2d.count) for row in rows] == [(None, 20)]


def test_cross_validation_is_that_of_a_loop_written_out() -> None:
    found, _, _ = lab(0, 23)
    model = fit_model("poly", {"red": found}, 0)
    (row,) = evaluate_cross_validated(model, {"red": found}, {}, seed=7)
    by_place: dict[str, list[float]] = {}
    for residual in row.residuals:
        error = float(np.linalg.norm(residual.predicted_m - residual.world_m))
        by_place.setdefault(residual.measurement, []).append(error)
    assert {len(errors) for errors in by_place.values()} == {4}
    # No model predicts a point of its own fit: the error never approaches the residual of the fit.
    applied = AppliedModel("poly", model.cameras[0])
    points, world = (np.array([getattr(p, f) for p in found]) for f in ("camera_m", "world_m"))
    inside = np.linalg.norm(applied.predict(points, world[:, 2]) - world, axis=1)
    assert row.error_3d is not None
    assert row.error_3d.mean_m > 1.3 * inside.mean()
    again = evaluate_cross_validated(model, {"red": found}, {}, seed=8)
    assert again[0].error_3d != row.error_3d


def test_cross_validated_errors_are_compared_with_the_model_of_their_fold() -> None:
    """Twenty points: a fold's model is much less certain than the model of all points."""
    found, _, _ = lab(0, 20)
    model = fit_model("poly", {"red": found}, 0)
    (row,) = evaluate_cross_validated(model, {"red": found}, {}, seed=7)
    within = 0
    folds = make_folds(gather_points({"red": found}), FOLDS, np.random.default_rng(7))
    for fold in folds:
        rest = {"red": [p for p in found if p.measurement not in fold]}
        cameras, others = gather_points(rest), [other for other in folds if other != fold]
        without = others, {"red": np.array([predict_without("poly", cameras, o)["red"] for o in others])}
        fitted = fit_cameras("poly", cameras)
        applied = AppliedModel("poly", *describe_camera_models("poly", cameras, rest, fitted, without))
        for pair in (p for p in found if p.measurement in fold):
            point, height = pair.camera_m[None], pair.world_m[2:]
            covariances = applied.covariances(point, height)
            assert covariances is not None
            assert pair.world_covariance_m2 is not None
            offset = applied.predict(point, height)[0] - pair.world_m
            square = offset @ np.linalg.inv(covariances[0] + pair.world_covariance_m2) @ offset
            within += square <= chi2.ppf(0.68, 3)
    assert row.within_68 == pytest.approx(within / 20)


def test_measurements_of_one_point_are_in_one_fold_and_tie_cameras() -> None:
    found, _, _ = lab(0, 20)
    twins = [replace(p, measurement=f"w{n}", calibration_point=p.measurement) for n, p in enumerate(found)]
    cameras = gather_points({"red": found, "white": twins})
    for fold in make_folds(cameras, 5, np.random.default_rng(0)):
        assert {f"w{p[1:].lstrip('0') or 0}" for p in fold if p[0] == "m"} == {p for p in fold if p[0] == "w"}
    assert group_dependent_cameras("best", cameras) == [["red", "white"]]
    left_out = leave_one_out("best", cameras)(frozenset())["red"]["m03"]
    predicted = predict_without("best", cameras, {"m03", "w3"})["red"][3]
    np.testing.assert_array_equal(left_out, predicted)


def swapped(model: str, wrong: int | None) -> Evaluation:
    """Evaluate a model on 30 tape points; the two distances of one of them are exchanged."""
    rng = np.random.default_rng(5)
    world = labs.places(rng, 30)
    points = labs.camera(rng).see(world, rng)
    rig = replace(labs.RIG, tape_sigma_m=0.003)
    places, own = [], []
    for n, (world_m, point_m) in enumerate(zip(world, points, strict=True)):
        to_a, to_b = (
            float(np.hypot(*(world_m[:2] - end)) + rng.normal(0, 0.003)) for end in (labs.A, labs.B)
        )
        if n == wrong:
            to_a, to_b = to_b, to_a
        place = RiggedMeasurement(
            Measurement(
                n, f"m{n:02d}", marker_id=0, distances=(Distance("A", to_a), Distance("B", to_b)),
                side="right", height_m=float(world_m[2]),
            ),
            rig,
        )  # fmt: skip
        point = world_point(place.measurement, rig)
        places.append(place)
        own.append(Pair(f"m{n:02d}", 0, point_m, point.world_m, 1, point.covariance_m2))
    train = {"red": own[:24]}
    study = Study(places, {"red": own}, {p.measurement for p in own[24:]}, {}, {}, 0)
    return evaluate_model(fit_model(model, train, 0), study, 0, [], lambda done, total: None)


@pytest.mark.parametrize(
    ("model", "wrong"),
    [("rigid", 3), ("poly", 3), ("poly", 27), pytest.param("best", 3, marks=pytest.mark.slow)],
)
def test_exchanged_distances_of_one_point_change_no_conclusion(model: str, wrong: int) -> None:
    right, found = swapped(model, None), swapped(model, wrong)
    assert (right.excluded, right.with_excluded) == ((), ())
    assert [(s.measurement, s.kind) for s in found.excluded] == [(f"m{wrong:02d}", "swapped")]
    for row, clean, whole in zip(found.cameras, right.cameras, found.with_excluded, strict=True):
        assert (row.scheme, row.camera) == (clean.scheme, clean.camera) == (whole.scheme, whole.camera)
        assert row.error_3d is not None
        assert clean.error_3d is not None
        assert whole.error_3d is not None
        assert row.error_3d.mean_m == pytest.approx(clean.error_3d.mean_m, rel=0.4)
        assert all(residual.measurement != f"m{wrong:02d}" for residual in row.residuals)
        if row.scheme == "cross_validation":
            assert row.error_3d.count == clean.error_3d.count - 1
            assert whole.error_3d.mean_m > 5 * row.error_3d.mean_m
    for point, clean_point in zip(found.learning, right.learning, strict=False):
        assert point.mean_3d_m < 3 * clean_point.mean_3d_m


def test_point_of_two_cameras_is_held_out_from_both() -> None:
    def seen(*names: str) -> CalibrationPoints:
        return CalibrationPoints(np.zeros((len(names), 3)), np.zeros((len(names), 3)), names)

    cameras = {
        "red": seen(*(f"r{n}" for n in range(20)), *(f"b{n}" for n in range(5))),
        "white": seen(*(f"w{n}" for n in range(15)), *(f"b{n}" for n in range(5))),
    }
    folds = make_folds(cameras, 5, np.random.default_rng(0))
    assert sorted(name for fold in folds for name in fold) == sorted(
        {name for places in cameras.values() for name in places.names}
    )
    for places in cameras.values():
        sizes = [len(fold & set(places.names)) for fold in folds]
        assert max(sizes) - min(sizes) <= 1


def test_leave_one_out_equals_a_fit_without_the_point() -> None:
    found, _, _ = lab(1, 16)
    cameras = gather_points({"red": found})
    left_out = leave_one_out("poly", cameras)(frozenset({"m03"}))["red"]
    rest = {"red": [p for p in found if p.measurement not in ("m03", "m05")]}
    applied = AppliedModel("poly", fit_model("poly", rest, 0).cameras[0])
    np.testing.assert_allclose(
        left_out["m05"], applied.predict(found[5].camera_m[None], np.zeros(1))[0], atol=1e-9
    )
    assert set(left_out) == {p.measurement for p in found}


def test_learning_curve_falls_with_more_points() -> None:
    found, _, _ = lab(2, 60)
    curve = [p for points in learning_curve("poly", gather_points({"red": found}), 0) for p in points]
    assert [p.pairs for p in curve] == [10, 15, 20, 30, 40]
    assert curve[0].mean_3d_m > 3 * curve[-1].mean_3d_m
    assert [p.subsets for p in curve] == [10, 10, 5, 5, 5]
    assert all(p.std_3d_m <= 0.1 * p.subsets**0.5 * p.mean_3d_m for p in curve if p.subsets < 10)


def test_published_subsets_are_evaluated_as_in_the_paper() -> None:
    found, _, _ = lab(3, 30)
    cameras = gather_points({"red": found})
    names = [p.measurement for p in found]
    (point,) = published_curve("poly", cameras, {"train_12": set(names[:12])}, set(names[20:]))
    assert (point.pairs, point.label) == (12, "train_12")
    predicted = predict_without("poly", cameras, set(names[12:]))["red"][20:]
    errors = np.linalg.norm(predicted - cameras["red"].world_m[20:], axis=1)
    assert point.mean_3d_m == pytest.approx(errors.mean())
    assert labelled_subsets([]) == {}


def test_covariance_is_for_held_out_errors() -> None:
    rng = np.random.default_rng(1)
    noisy = [
        Pair(p.measurement, 0, p.camera_m, p.world_m + rng.normal(0, 0.01, 3), 1) for p in pairs(np.zeros(3))
    ]
    covariance = fit_model("poly", {"red": noisy}, 0).cameras[0].covariance_m2
    assert covariance is not None
    # With 14 pairs for 10 parameters, the residuals are small but the errors are not.
    assert np.sqrt(np.trace(covariance) / 3) > 0.015
    few = fit_model("poly", {"red": noisy[:10]}, 0).cameras[0]
    assert (few.covariance_m2, few.noise) == (None, None)


def regions(name: str, along: float, seeds: Sequence[int]) -> tuple[float, float]:
    """Return the shares of true positions within the 68 % and 95 % regions of their positions."""
    size = 2 if name == "rayplane" else 3
    within: list[Mapping[float, float]] = []
    for seed in seeds:
        found, points, world = lab(seed, along=along)
        camera = fit_model(name, {"red": found}, 0).cameras[0]
        applied = AppliedModel(name, camera)
        covariances = applied.covariances(points, world[:, 2])
        assert covariances is not None
        offsets = (applied.predict(points, world[:, 2]) - world)[:, :size]
        inverse = np.linalg.inv(covariances[:, :size, :size])
        squares = np.einsum("ni,nij,nj->n", offsets, inverse, offsets)
        within.append({share: float((squares <= chi2.ppf(share, size)).mean()) for share in (0.68, 0.95)})
    return tuple(float(np.mean([w[share] for w in within])) for share in (0.68, 0.95))  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("name", "along"),
    [
        ("poly", 0.0004), ("poly", 0.003), ("rayplane", 0.003), ("best", 0.0004),
        pytest.param("rayplane", 0.0004, marks=pytest.mark.slow),
        pytest.param("best", 0.003, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_covariance_regions_contain_the_truth_at_their_rate(name: str, along: float) -> None:
    """All positions of a session share its tape errors, so the test needs many sessions."""
    within_68, within_95 = regions(name, along, range(40))
    assert 0.60 <= within_68 <= 0.76
    assert 0.90 <= within_95 <= 0.98


def test_covariance_includes_most_of_a_model_misfit() -> None:
    """The remaining lens error of rigid is no noise: it is equal at near positions and not Gaussian."""
    within_68, within_95 = regions("rigid", 0.0004, range(40))
    assert 0.55 <= within_68 <= 0.76
    assert 0.80 <= within_95 <= 0.98


def test_sigma_of_a_measured_height_is_that_of_its_ruler() -> None:
    world = labs.places(np.random.default_rng(0), 3)
    seen = labs.pairs(world, world, labs.tape_covariances(world, 0.001, 0.005))
    np.testing.assert_allclose(height_sigmas(seen), 0.005)
    np.testing.assert_allclose(height_sigmas([replace(seen[0], world_covariance_m2=None)]), 0.0005)


@pytest.mark.parametrize("ruler_m", [0.001, 0.005])
def test_covariance_of_known_heights_includes_their_sigma(ruler_m: float) -> None:
    """Held-out points by an accurate tape and a ruler: the error of the height moves the ray's point."""
    within: list[float] = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        camera = labs.camera(rng)
        seen = []
        for count in (40, 60):
            world = labs.places(rng, count)
            covariances = labs.tape_covariances(world, 0.001, ruler_m)
            roots = np.linalg.cholesky(covariances)
            tape = world + np.einsum("nij,nj->ni", roots, rng.normal(size=world.shape))
            seen.append(labs.pairs(camera.see(world, rng), tape, covariances, f"{count}_"))
        (row,) = evaluate_held_out(fit_model("rayplane", {"red": seen[0]}, 0), {"red": seen[1]}, {})
        assert row.within_68 is not None
        within.append(row.within_68)
    assert 0.62 <= np.mean(within) <= 0.76, np.mean(within)


def test_uncertainty_grows_away_from_the_calibration_points() -> None:
    found, _, _ = lab(5)
    inner = [p for p in found if 1.0 < p.world_m[0] < 3.8]
    applied = AppliedModel("poly", fit_model("poly", {"red": inner}, 0).cameras[0])
    middle, edge = np.array([[0.0, 0.0, 2.0]]), np.array([[2.3, 0.0, 2.0]])
    sizes = [np.trace(applied.covariances(p, np.zeros(1))[0]) for p in (middle, edge)]  # type: ignore[index]
    assert sizes[1] > 9 * sizes[0]


def test_fold_with_too_few_points_is_an_error() -> None:
    found, _, _ = lab(7, min_pairs("poly") + 1)
    with pytest.raises(FitError):
        predict_without("rigid", gather_points({"red": found}), {p.measurement for p in found[2:]})


def tracked(time_ns: int, x_m: float) -> Message:
    return Message("t", time_ns, time_ns, Tracks(time_ns, (Track("robot_0", 0, x_m, 0.0, 0.0),)))


def test_the_last_pose_of_an_instant_counts() -> None:
    truth = gather_tracks([tracked(1, 0.0), tracked(2, 1.0)])
    tracks = gather_tracks([tracked(1, 0.5), tracked(1, 0.01), tracked(2, 1.02), tracked(3, 9.0)])
    found = track_errors(tracks, truth)
    assert found is not None
    assert found[0].count == 2
    assert found[0].mean_m == pytest.approx(0.015)
    assert track_errors(tracks, {}) is None
