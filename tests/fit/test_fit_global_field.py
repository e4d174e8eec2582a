"""The global network by Gauss-Newton: what its steps lower, what outliers and wrong signs do to it, and its size."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gnrecon.field.networks import Siren
from gnrecon.fit import FitOptions, fit
from gnrecon.fit.fit_options import network_steps
from gnrecon.fit.global_field import GlobalField, fit_global
from gnrecon.fit.global_network import Deviations, NetworkTerms, Prediction
from gnrecon.fit.initialisation import random_network
from gnrecon.fit.network_ladder import NetworkLadder, Rival
from gnrecon.fit.objective import Scene
from gnrecon.fit.parameters import (
    FitParameters,
    GlobalFieldParameters,
    NetworkLadderParameters,
    NetworkTermParameters,
)
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.optim import Record, Solution
from gnrecon.runtime.errors import FitError
from gnrecon.runtime.parallel import fixed_sums
from gnrecon.runtime.progress import ignore_progress

FRAME = Frame(np.array([1.0, 2.0, 3.0]), 2.0)
# A network in any case: the linear field predicts the clean capsule of these tests well enough.
TWO_WIDTHS = GlobalFieldParameters(
    ladder=NetworkLadderParameters(widths=(12, 16), starts=1, most_members=1, gain_standard_errors=-1e9),
    exact_score=0.0,
)


def capsule(count: int, seed: int) -> Samples:
    """Points of a capsule: all within 0.3 of the axis from -0.5 to 0.5."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((count, 3))
    x *= 0.3 / np.linalg.norm(x, axis=1, keepdims=True)
    normals = x / 0.3
    # The round ends have as much area as a cylinder of length 0.6, to which one of length 1 is added.
    along = rng.random(count) < 1 / 1.6
    ring = normals[along, :2] / np.linalg.norm(normals[along, :2], axis=1, keepdims=True)
    normals[along] = np.column_stack([ring, np.zeros(len(ring))])
    x[along] = 0.3 * normals[along] + np.column_stack([np.zeros((len(ring), 2)), rng.uniform(-0.5, 0.5, len(ring))])
    x[~along, 2] += 0.5 * np.sign(x[~along, 2])
    return Samples(x, normals, FRAME)


def distance(x: Float) -> Float:
    axis = np.zeros_like(x)
    axis[:, 2] = x[:, 2].clip(-0.5, 0.5)
    return np.asarray(np.linalg.norm(x - axis, axis=1) - 0.3)


def held_out(samples: Samples) -> Mask:
    mask = np.zeros(len(samples), dtype=bool)
    mask[::6] = True
    return mask


def fitted(samples: Samples, parameters: GlobalFieldParameters, records: list[Record] | None = None) -> GlobalField:
    out = held_out(samples)
    rows = np.flatnonzero(~out)
    callback = None if records is None else records.append
    rng = np.random.default_rng(3)
    return fit_global(samples, out, rows, FitOptions(), rng, ignore_progress, callback, parameters=parameters)


@pytest.fixture(scope="module")
def network() -> tuple[GlobalField, list[Record]]:
    records: list[Record] = []
    return fitted(capsule(900, 0), TWO_WIDTHS, records), records


def test_steps_are_recorded_with_the_eikonal_residual(network: tuple[GlobalField, list[Record]]) -> None:
    found, records = network
    assert found.ladder is not None
    assert tuple(records) == found.solution.history
    assert [record.step for record in records] == list(range(1, len(records) + 1))
    assert all(0 < a.seconds < b.seconds for a, b in itertools.pairwise(records))
    first, last = records[0].eikonal, records[-1].eikonal
    assert first is not None
    assert last is not None
    assert last < 0.1
    assert last < 0.3 * first


def test_the_field_is_a_distance_whose_sign_is_right_in_all_of_the_box(
    network: tuple[GlobalField, list[Record]],
) -> None:
    sdf = network[0].sdf
    x = sdf.box.sample(20_000, np.random.default_rng(1))
    value = sdf.sdf(FRAME.to_world(x)) / FRAME.scale
    clear = np.abs(distance(x)) > 0.03
    assert (value * distance(x) > 0)[clear].all()
    truth = capsule(2000, 5)
    value, gradient = sdf.sdf_and_gradient(FRAME.to_world(truth.points))
    assert np.abs(value).mean() / FRAME.scale < 3e-3
    assert np.linalg.norm(gradient - truth.normals, axis=1).mean() < 0.1


def test_steps_on_all_points_come_nearer_to_those_left_out() -> None:
    """Of few points: of many, those left out tell the network nothing that their neighbours do not."""

    def nearer(seed: int) -> float:
        samples = capsule(45, seed)
        found = fitted(samples, TWO_WIDTHS)
        left = FRAME.to_world(samples.points[held_out(samples)])
        before, after = (np.abs(sdf.sdf(left)).mean() for sdf in (found.sdf, found.refitted(samples)))
        return float(after / before)

    assert np.median([nearer(seed) for seed in range(3)]) < 0.7


def test_outliers_and_contradicting_normals_lose_their_weight() -> None:
    clean, rng = capsule(500, 0), np.random.default_rng(2)
    wrong = rng.permutation(500)[:25]
    points, normals = clean.points.copy(), clean.normals.copy()
    points[wrong] += 0.1 * normals[wrong]
    normals[wrong] *= -1
    truth = capsule(2000, 5).points

    def off(parameters: GlobalFieldParameters) -> float:
        sdf = fitted(replace(clean, points=points, normals=normals), parameters).sdf
        return float(np.abs(sdf.sdf(FRAME.to_world(truth))).mean()) / FRAME.scale

    least_squares = replace(TWO_WIDTHS, terms=NetworkTermParameters(robust_degrees_of_freedom=1e6))
    assert off(TWO_WIDTHS) < 0.7 * off(least_squares)


def terms_of(samples: Samples, rng: np.random.Generator) -> NetworkTerms:
    out = held_out(samples)
    seen = samples.select(~out)
    return NetworkTerms.draw(Scene.of(seen, "cpu", rng), samples.points[out], samples.normals[out], rng)


def test_free_space_is_drawn_where_the_field_is_wrong(rng: np.random.Generator) -> None:
    terms = terms_of(capsule(600, 0), rng)
    field = Siren((8, 8))
    theta = random_network(field, rng, terms.scene.points)
    flat = theta.clone()
    flat[-1] = 0.5  # positive everywhere: wrong inside alone
    problem = terms.problem(field, flat, Deviations(0.01, 0.1), rng)
    (free,) = (term for term in problem.terms if term.name == "free space")
    x = free.points.numpy()
    inside = distance(x) < 0
    wrong = len(x) - min(len(terms.scene.points), len(terms.free.points))
    assert 0 < wrong <= inside.sum()
    assert inside.mean() > 1.3 * (terms.free.signed < 0).double().mean().item()
    least, most = free.target.T.numpy()  # type: ignore[union-attr]
    assert (least < most).all()
    assert (np.sign(least) == np.sign(distance(x))).all()
    again = terms.with_wrong_signs(field, flat, rng)
    assert len(again.free.points) > len(terms.free.points)
    assert (distance(again.free.points[len(terms.free.points) :].numpy()) < 0).all()


def test_an_open_end_is_closed_by_a_film(rng: np.random.Generator) -> None:
    axis = np.ones(3) / np.sqrt(3)
    normals = rng.standard_normal((900, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # The ball ends oblique to its box, which leaves the network room to go on beyond the cut, as a ball does.
    normals = normals[0.8 * normals @ axis < 0.15]
    points = (0.8 + 0.005 * rng.standard_normal((len(normals), 1))) * normals
    heights = np.linspace(-0.3, 0.9, 241)

    def end(film_share: float) -> float:
        """The height at which the field ends."""
        terms = NetworkTermParameters(film_deviation_share=film_share)
        sdf = fitted(Samples(points, normals, FRAME), replace(TWO_WIDTHS, terms=terms)).sdf
        return float(heights[sdf.sdf(FRAME.to_world(heights[:, None] * axis)) < 0].max())

    assert abs(end(NetworkTermParameters.film_deviation_share) - 0.15) < 0.15
    assert end(1e6) > 0.4, "without the rows of gaps the network goes on as a ball"


def test_samples_of_gaps_are_near_a_film_and_no_score_counts_them(rng: np.random.Generator) -> None:
    whole = capsule(1200, 0)
    kept = whole.points[:, 2] < 0.2
    terms = terms_of(replace(whole, points=whole.points[kept], normals=whole.normals[kept]), rng)
    x = terms.gaps.points.numpy()
    across = (np.hypot(x[:, 0], x[:, 1]) < 0.15) & (x[:, 2] > 0)
    heights = x[across, 2] - 0.2
    assert len(heights) > 30
    # The lid is at 0.2: inside below, and outside above.
    assert np.corrcoef(terms.gaps.signed.numpy()[across], heights)[0, 1] > 0.8
    data = terms.gaps.deviation.numpy() / NetworkTermParameters.film_deviation_share
    assert (np.abs(terms.gaps.signed.numpy()) <= 0.5 * data + 1e-9).all()
    field = Siren((8, 8))
    theta = random_network(field, rng, terms.scene.points)
    without = replace(terms, gaps=terms.gaps.take(slice(0)))
    assert without.score(field, theta) == terms.score(field, theta)
    rows = [len(one.problem(field, theta, Deviations(0.01, 0.1), rng).terms[2]) for one in (terms, without)]
    expected = len(terms.gaps) / (len(terms.free) + len(terms.gaps)) * len(terms.scene.points)
    assert rows[0] - rows[1] == pytest.approx(expected, abs=1.0)


def test_the_noise_of_the_data_is_that_of_the_validation_points(rng: np.random.Generator) -> None:
    exact = capsule(1500, 0)
    noisy = replace(exact, points=exact.points + 0.02 * rng.standard_normal((1500, 1)) * exact.normals)
    terms = replace(terms_of(noisy, rng), points=torch.as_tensor(noisy.points), normals=torch.as_tensor(noisy.normals))
    terms = replace(terms, parameters=NetworkTermParameters(least_deviation=1e-9))
    field = fitted(exact, TWO_WIDTHS).sdf
    assert terms.noise(field.field, field.theta).values == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("estimated", "clean", "least"),
    [
        pytest.param(False, None, NetworkTermParameters.least_deviation, id="given"),
        pytest.param(True, None, NetworkTermParameters.least_estimated_deviation, id="by neighbourhoods"),
        pytest.param(True, True, NetworkTermParameters.least_sparse_deviation, id="of the smoothest surface"),
        pytest.param(True, False, NetworkTermParameters.least_sparse_deviation, id="by winding number"),
    ],
)
def test_estimated_normals_are_off_by_more_than_validation_points_show(
    estimated: bool, clean: bool | None, least: float, rng: np.random.Generator
) -> None:
    terms = terms_of(replace(capsule(400, 0), estimated=estimated, clean=clean), rng)
    field = Siren((8, 8))
    theta = random_network(field, rng, terms.scene.points)
    terms = replace(terms, normals=field.value_and_gradient(theta, terms.points)[1])
    assert terms.noise(field, theta).normals == least


def test_a_normal_counts_as_its_deviation_says(rng: np.random.Generator) -> None:
    deviations = rng.choice([0.02, 0.5], 400)
    known = replace(capsule(400, 0), estimated=True, clean=True, deviations=deviations)
    terms = terms_of(known, rng)
    field = Siren((8, 8))
    theta = random_network(field, rng, terms.scene.points)
    # The field turns every normal by an angle of its own; take those that it gives, so that robust weights are equal.
    scene = replace(terms.scene, normals=field.value_and_gradient(theta, terms.scene.points)[1])
    exact = replace(terms, scene=scene, normals=field.value_and_gradient(theta, terms.points)[1])
    noise = exact.noise(field, theta)
    assert noise.normals == NetworkTermParameters.least_deviation, "the least one is that of each normal"
    sure = scene.deviations is not None and scene.deviations < 0.1
    for floor in (noise.normals, 0.1):
        problem = exact.problem(field, theta, replace(noise, normals=floor), np.random.default_rng(0))
        weight = next(term.weight for term in problem.terms if term.name == "normal")
        expected = (0.5 / max(0.02, floor)) ** 2
        assert isinstance(weight, torch.Tensor)
        assert float(weight[sure].min() / weight[~sure].max()) == pytest.approx(expected, rel=1e-6)


def test_sparse_points_get_several_small_networks_and_dense_ones_one(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    made: list[tuple[int, ...]] = []

    def no_steps(self: NetworkLadder, field: Siren, theta: torch.Tensor, steps: int, **_: int) -> Solution:
        del self, steps
        made.append(field.widths)
        return Solution(theta, "", ())

    monkeypatch.setattr(NetworkLadder, "_fitted", no_steps)
    monkeypatch.setattr(NetworkTerms, "score", lambda *_: 1.0)
    monkeypatch.setattr(Prediction, "is_better_than", lambda *_, **__: True)
    parameters = NetworkLadderParameters(widths=(4, 24, 32), points_per_member=600, most_members=4)
    NetworkLadder(terms_of(capsule(360, 0), rng), FitOptions(), rng, parameters=parameters).fit()
    assert made == [(4,) * 3] * 4, "1,321 parameters are more than the 1,200 rows of 300 points"
    made.clear()
    NetworkLadder(terms_of(capsule(900, 0), rng), FitOptions(), rng, parameters=parameters).fit()
    expected = [(4,) * 3] * 5 + [(24,) * 3, (32,) * 3]
    assert made == expected, "one network has three starts, and the best goes on with few rows and then with all"
    made.clear()
    NetworkLadder(terms_of(capsule(1700, 0), rng), FitOptions(), rng, parameters=parameters).fit()
    assert made == [(4,) * 3] * 5 + [(32,) * 3], "1,321 parameters are fewer than the 1,416 points"


def test_a_score_has_a_bounded_number_of_validation_points(rng: np.random.Generator) -> None:
    samples = capsule(900, 0)
    scene, parameters = terms_of(samples, rng).scene, NetworkTermParameters(most_validation_points=100)
    terms = NetworkTerms.draw(scene, samples.points, samples.normals, rng, parameters=parameters)
    # Spread over all of them, with their own normals.
    np.testing.assert_array_equal(terms.points.numpy(), samples.points[::9])
    np.testing.assert_array_equal(terms.normals.numpy(), samples.normals[::9])


def test_all_starts_but_the_best_end_early(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    original, taken = NetworkLadder._fitted, []

    def recorded(self: NetworkLadder, field: Siren, theta: torch.Tensor, steps: int, **how: Any) -> Solution:
        solution = original(self, field, theta, steps, **how)
        taken.append((steps, (how.get("terms") or self.terms).parameters.data_rows, how.get("damping"), solution))
        return solution

    monkeypatch.setattr(NetworkLadder, "_fitted", recorded)
    parameters = NetworkLadderParameters(widths=(6,), trial_steps=3, first_steps=5, first_rows=300, points_per_member=1)
    ladder = NetworkLadder(terms_of(capsule(900, 0), rng), FitOptions(), rng, parameters=parameters)
    field, solution, _ = ladder.fit()
    assert [steps for steps, *_ in taken] == [3, 3, 3, 2, 5]
    assert [rows for _, rows, _, _ in taken[:4]] == [300] * 4
    assert taken[4][1] > 300
    # The start of the least score goes on, with the damping that it had.
    best = min((one[3] for one in taken[:3]), key=lambda one: ladder.terms.score(field, one.theta))
    assert [damping for *_, damping, _ in taken] == [None] * 3 + [best.history[-1].damping, None]
    assert len(solution.history) == sum(len(one[3].history) for one in taken)
    assert [record.step for record in solution.history] == list(range(1, len(solution.history) + 1))
    assert network_steps(900, parameters=parameters) == 16


@pytest.mark.parametrize("count", [360, 900])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_rival_that_is_exact_needs_no_network(count: int, threads: int, rng: np.random.Generator) -> None:
    rival = Rival(lambda: 0.05, exact_score=0.1)
    ladder = NetworkLadder(terms_of(capsule(count, 0), rng), FitOptions(), rng, rival=rival)
    with fixed_sums(threads):
        assert ladder.fit() is None
    assert ladder.history == []


def test_no_more_networks_are_fitted_where_the_rival_is_better() -> None:
    parameters = NetworkLadderParameters(widths=(4,), first_steps=2, points_per_member=600)

    def scores(threads: int, rival: float) -> list[float | None]:
        rng = np.random.default_rng(1)
        ladder = NetworkLadder(
            terms_of(capsule(360, 0), rng), FitOptions(), rng, rival=Rival(lambda: rival), parameters=parameters
        )
        with fixed_sums(threads):
            assert ladder.fit() is not None
        return [record.held_out for record in ladder.history]

    both, one = scores(1, 1e9), scores(1, 0.0)
    assert len(both) == 2 * len(one)
    assert (scores(3, 1e9), scores(3, 0.0)) == (both, one)


def test_the_error_of_a_rival_is_that_of_the_fit(rng: np.random.Generator) -> None:
    def fails() -> float:
        raise FitError("no")

    for threads in (1, 2):
        ladder = NetworkLadder(terms_of(capsule(360, 0), rng), FitOptions(), rng, rival=Rival(fails))
        with fixed_sums(threads), pytest.raises(FitError, match="no"):
            ladder.fit()


def test_an_interrupt_ends_the_fit_also_where_an_earlier_network_is_better(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    ends = iter([False] * 5 + [True])  # two members, each started, continued and widened; Ctrl-C in the last one

    def no_steps(self: NetworkLadder, field: Siren, theta: torch.Tensor, steps: int, **_: int) -> Solution:
        del self, field, steps
        return Solution(theta, "Interrupted.", (), interrupted=next(ends))

    scores = itertools.count(1)  # each network is worse than the one before
    monkeypatch.setattr(NetworkLadder, "_fitted", no_steps)
    monkeypatch.setattr(NetworkTerms, "score", lambda *_: 1.0 if next(scores) % 2 else 0.98)
    parameters = NetworkLadderParameters(widths=(4, 12), points_per_member=600, most_members=2)
    ladder = NetworkLadder(terms_of(capsule(360, 0), rng), FitOptions(), rng, parameters=parameters)
    assert ladder.fit()[1].interrupted


def test_an_interrupt_of_the_last_steps_is_not_lost(
    network: tuple[GlobalField, list[Record]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: NetworkTerms, *args: object) -> None:
        del self, args
        raise KeyboardInterrupt

    monkeypatch.setattr(NetworkTerms, "problem", interrupted)
    with pytest.raises(KeyboardInterrupt):
        network[0].refitted(capsule(900, 0))


def test_an_interrupt_during_the_steps_keeps_the_network_so_far() -> None:
    def interrupting(record: Record) -> None:
        if record.step == 3:
            raise KeyboardInterrupt

    sdf, solution = fit(capsule(900, 0), FitOptions(), interrupting, parameters=FitParameters(global_field=TWO_WIDTHS))
    assert solution.interrupted
    assert sdf.detail is None
    assert len(solution.history) == 3
    assert "Interrupted" in solution.status
    assert "global field alone" in solution.status


def test_the_default_fits_a_network_and_says_so_and_a_draft_does_not() -> None:
    parameters = FitParameters(global_field=TWO_WIDTHS)
    _, solution = fit(capsule(600, 0), FitOptions(), parameters=parameters)
    assert f"by {len(solution.history)} Gauss-Newton steps" in solution.status
    assert all(record.eikonal is not None for record in solution.history)
    assert FitOptions().steps_for(600) >= len(solution.history) > 0
    _, linear = fit(capsule(300, 0), FitOptions(quality="draft"), parameters=parameters)
    assert linear.history == ()
    assert FitOptions(quality="draft").steps_for(300) == 0


def test_noise_that_two_predictions_share_hides_no_gain_and_chance_is_none(rng: np.random.Generator) -> None:
    noise = torch.as_tensor(rng.exponential(1.0, 200))
    right = torch.zeros(1000, dtype=torch.bool)

    def with_misfits(misfits: torch.Tensor, wrong: torch.Tensor = right) -> Prediction:
        return Prediction(misfits, wrong, wrong_sign_score=100.0)

    plain = with_misfits(noise)
    small = 0.02 * torch.as_tensor(rng.random(200))
    assert with_misfits(noise - small).is_better_than(plain, standard_errors=2.0)
    assert not plain.is_better_than(with_misfits(noise - small), standard_errors=2.0)
    by_chance = noise + torch.as_tensor(rng.choice([-0.5, 0.5], 200)) - 0.01
    assert with_misfits(by_chance).score != plain.score
    assert not with_misfits(by_chance).is_better_than(plain, standard_errors=3.0)
    sheets = torch.arange(1000) < 20
    assert plain.is_better_than(with_misfits(noise, sheets), standard_errors=2.0)
    assert with_misfits(noise, sheets).score == pytest.approx(plain.score + 2.0)


def test_an_outlier_is_a_point_that_no_field_explains(network: tuple[GlobalField, list[Record]]) -> None:
    samples = capsule(50, 1)
    of_network, of_linear = network[0].values(samples)
    assert np.abs(of_network - of_linear).max() > 0
    assert np.abs(of_linear).mean() / FRAME.scale < 0.01


def test_the_best_of_the_starts_is_the_network(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    starts: list[torch.Tensor] = []

    def no_steps(self: NetworkLadder, field: Siren, theta: torch.Tensor, steps: int, **_: int) -> Solution:
        del self, field, steps
        starts.append(theta)
        return Solution(theta, "", ())

    def score(self: NetworkTerms, field: Siren, theta: torch.Tensor) -> float:
        del self, field
        return [3.0, 1.0, 2.0][next(i for i, start in enumerate(starts) if start is theta)]

    monkeypatch.setattr(NetworkLadder, "_fitted", no_steps)
    monkeypatch.setattr(NetworkTerms, "score", score)
    parameters = NetworkLadderParameters(widths=(4,), most_members=1)
    ladder = NetworkLadder(terms_of(capsule(300, 0), rng), FitOptions(), rng, parameters=parameters)
    _, solution, least = ladder.climb()
    assert least == 1.0
    assert solution.theta is starts[1]
    assert not torch.equal(starts[0], starts[1])
    assert len(starts) == 5, "few rows, then all"
    assert all(start is starts[1] for start in starts[3:]), "it alone goes on"
