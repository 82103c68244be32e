"""Fits of synthetic presses: lock, stiffness, offsets, map, scores."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from taichi_msm.palpation.fit import MIN_GAIN, PressFit, at_lock, fit_presses, lock_interval, with_lock_error
from taichi_msm.palpation.predict import build_map
from taichi_msm.palpation.presses import Presses
from taichi_msm.palpation.process import correlation, fit_process
from taichi_msm.palpation.scores import score
from tests.palpation.synthetic import (
    LOCK,
    MEAN_OFFSET,
    OFFSET_WIDTH,
    RADIUS,
    Truth,
    log_stiffness,
    make_presses,
)

COUNT, NOISE, SCATTER = 200, 0.02, 0.05


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_presses(COUNT, noise=NOISE, scatter=SCATTER)


@pytest.fixture(scope="module")
def fitted(truth: Truth) -> PressFit:
    return fit_presses(truth.presses, RADIUS)


def assert_covered(share: float, expected: float, count: int) -> None:
    """Compare a share with its expectation, within 3.5 standard deviations of independent values."""
    assert abs(share - expected) < 3.5 * math.sqrt(expected * (1 - expected) / count), share


def test_exact_presses_are_recovered() -> None:
    exact = make_presses(30, noise=0.0)
    fit = fit_presses(exact.presses, RADIUS)
    # The search for the lock stops within 1e-3 of its logarithm; K and offset follow it by some times as much.
    assert fit.law.lock == pytest.approx(LOCK, rel=2e-3)
    np.testing.assert_allclose(fit.stiffness, exact.stiffness, rtol=0.02)
    np.testing.assert_allclose(fit.offset, exact.offset, atol=2e-5)


def test_shallow_press_that_does_not_touch_at_the_mean_offset() -> None:
    made = make_presses(30).presses
    # The table counts depths from 1.5 mm before the contact, but those of the first press from the contact.
    depth = np.where(made.index == 0, made.depth / 10, made.depth + 1.5e-3)
    shallow = Presses(made.places, made.position, made.index, depth, made.force)
    fit = fit_presses(shallow, RADIUS)
    assert fit.prior.mean < -depth[made.index == 0].max()
    assert (fit.mean_stiffness > 0).all()
    assert np.isfinite(build_map(shallow, fit).process.mean)


def test_lock_and_prior_are_recovered(truth: Truth, fitted: PressFit) -> None:
    low, high = lock_interval(truth.presses, fitted)
    # 0.5 % outside for another sample would be as good; here the interval has the lock.
    assert high is not None
    assert low < LOCK < high
    assert (high - low) / LOCK < 0.05
    at_ends = [at_lock(truth.presses, fitted, end).log_likelihood for end in (low, high)]
    # The search for the ends is accurate to 1e-3 of log m, over an interval of 0.02 with a gain of 2.
    np.testing.assert_allclose(fitted.log_likelihood - np.array(at_ends), MIN_GAIN, atol=0.4)
    # The offset of a press is known to about its width, so mean and width to 2^(1/2) width / count^(1/2) and less.
    assert fitted.prior.mean == pytest.approx(MEAN_OFFSET, abs=6e-5)
    assert fitted.prior.width == pytest.approx(OFFSET_WIDTH, rel=0.35)
    # N - 2 n degrees of freedom: 1600.
    assert fitted.prior.noise == pytest.approx(NOISE, rel=0.07)


def test_intervals_of_the_stiffness_cover_the_truth(truth: Truth, fitted: PressFit) -> None:
    error = with_lock_error(truth.presses, fitted, lock_interval(truth.presses, fitted)).error
    distance = np.abs(np.log(fitted.stiffness / truth.stiffness)) / error
    assert_covered(float(np.mean(distance < 1.96)), 0.95, COUNT)
    # The prior improves the offsets.
    assert np.std(fitted.offset - truth.offset) < OFFSET_WIDTH


def test_errors_include_those_of_the_lock(truth: Truth, fitted: PressFit) -> None:
    low, high = lock_interval(truth.presses, fitted)
    assert high is not None
    error = with_lock_error(truth.presses, fitted, (low, high)).error
    ends = [at_lock(truth.presses, fitted, lock).stiffness for lock in (low, high)]
    # From one end of a 95 % interval to the other there are 3.92 standard deviations, on both sides of the best lock.
    np.testing.assert_allclose(error**2 - fitted.error**2, (np.log(ends[1] / ends[0]) / 3.92) ** 2, rtol=0.1, atol=1e-9)


# Of these seeds, a lock gains 1.5, 1.1 and less than 0 in log likelihood.
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_linear_presses_have_no_lock(seed: int) -> None:
    linear = make_presses(60, lock=math.inf, seed=seed)
    fit = fit_presses(linear.presses, RADIUS)
    assert math.isinf(fit.law.lock)
    distance = np.abs(np.log(fit.stiffness / linear.stiffness)) / fit.error
    assert_covered(float(np.mean(distance < 1.96)), 0.95, 60)


def test_map_covers_the_truth(truth: Truth, fitted: PressFit) -> None:
    built = build_map(truth.presses, fitted)
    rng = np.random.default_rng(5)
    places = np.column_stack([rng.uniform(0.003, 0.057, 400), rng.uniform(0.003, 0.037, 400), np.zeros(400)])
    stiffness, low, high = built.stiffness(places)
    true = np.exp(log_stiffness(places))
    # Neighbouring places are correlated within a length: about 15 are independent. The map is smoother than a Matern
    # 3/2 process, and so covered more often.
    assert float(np.mean((low < true) & (true < high))) > 0.8
    # At a press the map is known to about the scatter over the square root of its neighbours.
    assert np.std(np.log(stiffness / true)) < SCATTER


def test_scores_and_coverage_of_new_presses(truth: Truth, fitted: PressFit) -> None:
    scores = score(truth.presses, fitted, lambda done, total: None)
    constant, nearest, by_map = (float(np.median(each)) for each in (scores.constant, scores.nearest, scores.map))
    # log K varies by 0.2, the root mean square of the map, and by 0.05 about it, with an offset of 0.1 of 3.7 mm as
    # much again. Over the rows of a press, the error is about half of that at the peak.
    assert by_map < nearest < constant
    assert 0.05 < constant < 0.15
    assert by_map < 0.7 * constant
    # Rows of a press are correlated: as for `COUNT` independent values.
    assert_covered(scores.coverage, 0.9, COUNT)
    residual = truth.presses.root_mean_square(
        (truth.presses.force - scores.forces.force) / truth.presses.peak[truth.presses.index]
    )
    np.testing.assert_allclose(residual, scores.map, rtol=1e-12)


def test_coverage_of_new_presses_with_other_offsets() -> None:
    shares = []
    for width, seed in ((1e-4, 1), (3e-4, 1), (1e-4, 2)):
        presses = make_presses(120, width=width, seed=seed).presses
        shares.append(score(presses, fit_presses(presses, RADIUS), lambda done, total: None).coverage)
    # 90 % within three standard deviations of 360 independent presses. If offsets counted both in the noise of the map
    # and by themselves, it would be 95 %.
    assert 0.85 < np.mean(shares) < 0.93


def test_width_of_the_offsets_in_small_tables() -> None:
    # Offsets are known to about their width, so without a prior a width of 0 is likeliest in some of these tables.
    widths = [fit_presses(make_presses(20, seed=seed).presses, RADIUS).prior.width for seed in range(500, 512)]
    assert min(widths) > OFFSET_WIDTH / 3
    assert np.median(widths) == pytest.approx(OFFSET_WIDTH, rel=0.5)


@pytest.mark.parametrize("coupling", [0.0, -900.0])
def test_predicted_intervals_at_every_depth(coupling: float) -> None:
    """Presses whose log K depends on their offset by `coupling` [1/m]: -900 balances its effect on the force."""
    known, new = (make_presses(count, width=4e-4, seed=seed) for count, seed in ((200, 1), (1000, 2)))
    presses, others = (
        replace(each.presses, force=each.presses.force * factor[each.presses.index])
        for each in (known, new)
        for factor in [np.exp(coupling * (each.offset - MEAN_OFFSET))]
    )
    forces = build_map(presses, fit_presses(presses, RADIUS)).predict(others)
    below, above = (
        outside.reshape(1000, 10).mean(axis=0) for outside in (others.force < forces.low, others.force > forces.high)
    )
    # 5 % by each end; of 1000 presses 0.7 % is a standard deviation, and the 200 that are known give as much again.
    # The effect of an offset of half the depth is no longer linear in log K, so fewer are below and more above.
    assert max(below.max(), above.max()) < 0.09, (below, above)
    assert 0.06 < (below + above).min() <= (below + above).max() < 0.13, (below, above)


def test_scores_use_the_other_presses_alone(truth: Truth, fitted: PressFit) -> None:
    some = truth.presses.subset(np.arange(15))
    fit = fit_presses(some, RADIUS)
    scores = score(some, fit, lambda done, total: None)
    # A press whose force is ten times as large is not predicted by its own rows.
    force = np.where(some.index == 3, 10 * some.force, some.force)
    changed = type(some)(some.places, some.position, some.index, some.depth, force)
    other = score(changed, fit, lambda done, total: None)
    rows = some.index == 3
    np.testing.assert_allclose(other.forces.force[rows], scores.forces.force[rows], rtol=1e-12)


def test_process_interpolates_and_returns_to_the_mean() -> None:
    rng = np.random.default_rng(2)
    places, length = np.column_stack([rng.uniform(0, 1, (150, 2)), np.zeros(150)]), 0.3
    covariance = correlation(places, places, length) + 1e-10 * np.eye(150)
    values = 5 + np.linalg.cholesky(covariance) @ rng.standard_normal(150)
    process = fit_process(places, values)
    # Length and variance of a process are known from 150 places to about a third each.
    assert process.length == pytest.approx(length, rel=0.5)
    mean, deviation = process.predict(places)
    np.testing.assert_allclose(mean, values, atol=0.05)
    assert deviation.max() < 0.1
    far, of_far = process.predict(np.array([[100.0, 0, 0]]))
    assert far[0] == pytest.approx(process.mean)
    # Further than the amplitude by the error of the mean.
    assert of_far[0] > math.sqrt((1 - process.share) * process.variance)


def test_process_is_the_best_linear_predictor() -> None:
    """Mean and variance against the equations of kriging with an unknown mean, with a Lagrange multiplier."""
    rng = np.random.default_rng(3)
    places, values = rng.uniform(0, 1, (20, 3)), rng.standard_normal(20)
    process = fit_process(places, values)
    at = rng.uniform(0, 1, (4, 3))
    amplitude = (1 - process.share) * process.variance
    inner = amplitude * correlation(places, places, process.length) + process.noise**2 * np.eye(20)
    between = amplitude * correlation(places, at, process.length)
    system = np.block([[inner, np.ones((20, 1))], [np.ones((1, 20)), np.zeros((1, 1))]])
    solved = np.linalg.solve(system, np.vstack([between, np.ones((1, 4))]))
    mean, deviation = process.predict(at)
    np.testing.assert_allclose(mean, solved[:20].T @ values, rtol=1e-8, atol=1e-8)
    variance = amplitude - (solved[:20] * between).sum(axis=0) - solved[20]
    np.testing.assert_allclose(deviation**2, variance, rtol=1e-6, atol=1e-9)
