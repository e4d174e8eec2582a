"""The solve of a patch against Bayesian regression with all matrices held whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gnrecon.field.cube_lattice import CubeLattice
from gnrecon.field.random_features import Features
from gnrecon.fit.free_space import LatticeVolume, Volume
from gnrecon.fit.local_solve import LocalRowSystem, Patch, PatchSystem, patch_system
from gnrecon.fit.parameters import LocalSolveParameters

LENGTH, POSITION, ANGLE = 0.4, 0.01, 0.2


@pytest.fixture
def features(rng: np.random.Generator) -> Features:
    return Features.draw(30, rng, torch.zeros(0, dtype=torch.float64))


@pytest.fixture
def patch(rng: np.random.Generator) -> Patch:
    shapes = [(20, 3), (20,), (20, 3), (8, 3), (8,), (8,)]
    *draws, bound = [torch.as_tensor(rng.standard_normal(shape)) for shape in shapes]
    # Of the samples two have both bounds, three the lower one alone and three the upper one alone.
    infinite = torch.full((3,), torch.inf).to(bound)
    lower, upper = torch.cat([bound[:5], -infinite]), torch.cat([bound[:2], infinite, bound[5:]])
    distance = torch.as_tensor(rng.uniform(0.5, 1.0, 8))
    return Patch(*draws, lower, upper, bound, distance, torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64))


def rows(features: Features, x: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """Values of all features at x, (N, m), and their gradients, (N, 3, m), by autodiff."""

    def value(point: Tensor) -> Tensor:
        return torch.sin(features.frequencies @ ((point - center) / LENGTH) + features.phases)

    gradients = torch.func.vmap(torch.func.jacrev(value))(x)
    return torch.func.vmap(value)(x), gradients.mT


def plainly(patch: Patch, features: Features) -> tuple[Tensor, Tensor]:
    """J and r of data and volume, each row over its standard deviation."""
    value, gradient = rows(features, patch.points, patch.center)
    free = rows(features, patch.volume, patch.center)[0]
    spread = (LocalSolveParameters.volume_deviation_share * patch.distance)[:, None]
    J = torch.cat([value / POSITION, gradient.reshape(-1, len(features)) / ANGLE, free / spread])
    r = torch.cat([patch.value / POSITION, patch.gradient.reshape(-1) / ANGLE, patch.wanted / spread[:, 0]])
    return J, r


@pytest.fixture
def double(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let free space have the precision of the data."""
    monkeypatch.setattr(Features, "precise_enough", lambda self, _: self)


@pytest.mark.parametrize("system", [PatchSystem, LocalRowSystem])
@pytest.mark.seed(1503570714)
@pytest.mark.usefixtures("double")
def test_amplitudes_are_the_mode_of_bayesian_regression(
    system: type[PatchSystem | LocalRowSystem], patch: Patch, features: Features
) -> None:
    prior = (
        LocalSolveParameters.correction_rms_factor
        * float(patch.value.square().mean().sqrt())
        * (2 / len(features)) ** 0.5
    )
    J, r = plainly(patch, features)
    expected = torch.linalg.solve(J.T @ J + torch.eye(len(features)) / prior**2, J.T @ r)
    found = system(patch, features, LENGTH, patch.size).solve(POSITION, ANGLE)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11)


def test_free_space_is_rounded_where_that_changes_little(
    patch: Patch, features: Features, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert features.precise_enough(1e4).phases.dtype == torch.float32
    assert features.precise_enough(1e6) is features
    rounded = PatchSystem(patch, features, LENGTH, patch.size).solve(POSITION, ANGLE)
    monkeypatch.setattr(Features, "precise_enough", lambda self, _: self)
    exact = PatchSystem(patch, features, LENGTH, patch.size).solve(POSITION, ANGLE)
    assert 0.0 < float((rounded - exact).norm()) < 1e-5 * float(exact.norm())


@pytest.mark.usefixtures("double")
def test_a_point_of_little_weight_counts_as_little(patch: Patch, features: Features, rng: np.random.Generator) -> None:
    weights = torch.as_tensor(rng.uniform(0.0, 1.0, 20))
    J, r = plainly(patch, features)
    roots = torch.cat([weights, weights.repeat_interleave(3), torch.ones(8)]).sqrt()
    J, r = J * roots[:, None], r * roots
    expected = torch.linalg.solve(J.T @ J + torch.eye(len(features)) * len(features) / 2 / patch.size**2, J.T @ r)
    found = patch_system(replace(patch, weights=weights), features, LENGTH, patch.size).solve(POSITION, ANGLE)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("system", [PatchSystem, LocalRowSystem])
@pytest.mark.usefixtures("double")
def test_a_normal_that_is_unsure_counts_as_little(
    system: type[PatchSystem | LocalRowSystem], patch: Patch, features: Features, rng: np.random.Generator
) -> None:
    weights = torch.as_tensor(rng.uniform(0.01, 1.0, 20))
    J, r = plainly(patch, features)
    roots = torch.cat([torch.ones(20), weights.repeat_interleave(3), torch.ones(8)]).sqrt()
    J, r = J * roots[:, None], r * roots
    expected = torch.linalg.solve(J.T @ J + torch.eye(len(features)) * len(features) / 2 / patch.size**2, J.T @ r)
    unsure = replace(patch, normal_weights=weights)
    found = system(unsure, features, LENGTH, patch.size).solve(POSITION, ANGLE)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)
    # Weights of the points count besides.
    halves = torch.full((20,), 0.5).to(weights)
    both = PatchSystem(replace(unsure, weights=halves), features, LENGTH, patch.size).solve(POSITION, ANGLE)
    product = replace(patch, weights=halves, normal_weights=None)
    assert not torch.allclose(both, PatchSystem(product, features, LENGTH, patch.size).solve(POSITION, ANGLE))
    wider = PatchSystem(unsure, features, LENGTH, patch.size).solve(2**0.5 * POSITION, 2**0.5 * ANGLE)
    torch.testing.assert_close(both, wider, rtol=1e-8, atol=1e-10)


def test_a_point_loses_its_weight_by_how_far_it_is_from_what_the_others_give(
    patch: Patch, features: Features, rng: np.random.Generator
) -> None:
    # Near each other, so that the others tell the value of a point.
    patch = replace(patch, points=0.1 * patch.points)
    value, gradient = rows(features, patch.points, patch.center)
    amplitudes = torch.as_tensor(rng.standard_normal(len(features)))
    noise = POSITION * torch.as_tensor(rng.standard_normal(20))
    # Of the outliers one has a weight already.
    given = torch.ones(20).double().index_fill(0, torch.tensor([11]), 0.3)
    off = torch.zeros(20).double().index_fill(0, torch.tensor([4, 11]), 50 * POSITION)
    free = rows(features, patch.volume, patch.center)[0] @ amplitudes
    seen = {"value": value @ amplitudes + noise + off, "gradient": gradient @ amplitudes, "wanted": free}
    patch = replace(patch, **seen, weights=given)
    J, r = plainly(patch, features)
    roots = torch.cat([given, given.repeat_interleave(3), torch.ones(8)]).sqrt()
    prior = torch.eye(len(features)) * len(features) / 2 / patch.size**2
    misfits = []
    for row in range(20):
        others = roots.clone().index_fill(0, torch.tensor([row]), 0.0)
        rest, wanted = J * others[:, None], r * others
        left_out = torch.linalg.solve(rest.T @ rest + prior, rest.T @ wanted)
        misfits.append(float((patch.value[row] - value[row] @ left_out).abs()))
    misfit = torch.tensor(misfits).double()
    deviation = max(POSITION, float(misfit.median()) / 0.6745)
    expected = (5.0 * deviation / misfit).square().clamp(max=1.0)
    found = PatchSystem(patch, features, LENGTH, patch.size).robust_weights(POSITION, ANGLE)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-8)
    assert set((found < 1.0).nonzero()[:, 0].tolist()) == {4, 11}


def test_a_correction_is_brought_within_its_bounds(patch: Patch, features: Features) -> None:
    # Loose data: what the prior and the volume's own weight leave of the bounds is seen.
    system, loose = PatchSystem(patch, features, LENGTH, patch.size), (1.0, 10.0)
    sines = rows(features, patch.volume, patch.center)[0]

    def beyond(amplitudes: Tensor) -> float:
        value = sines @ amplitudes
        return float((value - value.clamp(patch.lower, patch.upper)).norm())

    before = beyond(system.solve(*loose))
    assert before > 0.1
    assert beyond(system.solve_with_bounds(*loose)) < 0.1 * before
    # What was asked for stays in the equations that others add to.
    factor, right = system.equations(*loose) or pytest.fail("indefinite")
    assert beyond(torch.cholesky_solve(right[:, None], factor)[:, 0]) < 0.1 * before


def test_a_correction_within_its_bounds_is_left_alone(patch: Patch, features: Features) -> None:
    free = replace(patch, lower=torch.full((8,), -100.0).double(), upper=torch.full((8,), 100.0).double())
    system = PatchSystem(free, features, LENGTH, free.size)
    torch.testing.assert_close(system.solve_with_bounds(POSITION, ANGLE), system.solve(POSITION, ANGLE), rtol=0, atol=0)


def test_a_sample_at_half_of_its_bound_is_left_alone(patch: Patch, features: Features) -> None:
    """Its sign is right by far; what the bound protects from are surfaces between samples."""
    value = rows(features, patch.volume, patch.center)[0] @ PatchSystem(patch, features, LENGTH, patch.size).solve(
        POSITION, ANGLE
    )
    none = torch.full((8,), torch.inf).double()
    for beyond, moved in ((0.9, False), (1.1, True)):
        # The bound is one above the zero, and the value so much below it.
        bounded = replace(patch, lower=value + beyond / 2, upper=none, zero=value + beyond / 2 - 1.0)
        system = PatchSystem(bounded, features, LENGTH, patch.size)
        before = system.solve(POSITION, ANGLE)
        assert bool((system.solve_with_bounds(POSITION, ANGLE) != before).any()) == moved


def at_nodes(patch: Patch, samples: Volume) -> LatticeVolume:
    """Samples at all nodes of a lattice, each in a block of its own."""
    center = patch.center.numpy()
    return LatticeVolume(
        samples, CubeLattice(samples.points - center, np.zeros((1, 3))), np.arange(len(samples.points))
    )


def test_samples_near_the_data_keep_their_bounds_too(patch: Patch, features: Features) -> None:
    free = replace(patch, lower=torch.full((8,), -100.0).double(), upper=torch.full((8,), 100.0).double())
    system, loose = PatchSystem(free, features, LENGTH, patch.size), (1.0, 10.0)
    # Samples at which the corrected field must be at least 1 and is 0 where the correction is 0.5.
    points, ones = np.random.default_rng(0).standard_normal((30, 3)), np.ones(30)
    near = at_nodes(patch, Volume(points, ones, ones, np.inf * ones, 0.5 * ones, ones))

    def wrong(amplitudes: Tensor) -> int:
        return int((rows(features, torch.as_tensor(points), patch.center)[0] @ amplitudes < 0.5).sum())

    before, after = wrong(system.solve(*loose)), wrong(system.solve_with_bounds(*loose, near))
    assert before > 10
    assert after == 0


def test_near_the_data_a_right_sign_is_enough(patch: Patch, features: Features) -> None:
    free = replace(patch, lower=torch.full((8,), -100.0).double(), upper=torch.full((8,), 100.0).double())
    system, points, ones = PatchSystem(free, features, LENGTH, patch.size), patch.points[:4].numpy(), np.ones(4)
    before = system.solve(POSITION, ANGLE)
    value = (rows(features, patch.points[:4], patch.center)[0] @ before).numpy()
    for zero, moved in ((value - 0.01, False), (value + 0.01, True)):
        near = at_nodes(patch, Volume(points, ones, zero + 1.0, np.inf * ones, zero, ones))
        assert bool((system.solve_with_bounds(POSITION, ANGLE, near) != before).any()) == moved


def test_samples_that_stay_beyond_their_bounds_weigh_more_from_pass_to_pass(patch: Patch, features: Features) -> None:
    free = replace(patch, lower=torch.full((8,), -100.0).double(), upper=torch.full((8,), 100.0).double())
    ones = np.ones(4)
    near = at_nodes(patch, Volume(patch.points[:4].numpy(), ones, ones, np.inf * ones, 0.5 * ones, ones))

    def misfit(**changed: float) -> float:
        """How far the correction is from the bounds where the data contradicts them."""
        parameters = replace(LocalSolveParameters(), **changed)  # type: ignore[arg-type]
        system = PatchSystem(free, features, LENGTH, patch.size)
        found = system.solve_with_bounds(1e-3, ANGLE, near, parameters=parameters)
        return float((rows(features, patch.points[:4], patch.center)[0] @ found - 1.0).norm())

    assert misfit() < misfit(bound_tightening=1.0) < misfit(bound_passes=1)


@pytest.mark.usefixtures("double")
def test_samples_that_say_the_same_weigh_as_one(patch: Patch, features: Features) -> None:
    free = replace(patch, lower=torch.full((8,), -100.0).double(), upper=torch.full((8,), 100.0).double())
    near = patch.points[:1].numpy()
    apart = near + np.array([1.1 * LENGTH, 0.0, 0.0])

    def found(*places: np.ndarray) -> Tensor:
        points, ones = np.concatenate(places), np.ones(len(places))
        samples = at_nodes(patch, Volume(points, ones, 5 * ones, np.inf * ones, 5 * ones, ones))
        once = replace(LocalSolveParameters(), bound_passes=1)
        return PatchSystem(free, features, LENGTH, patch.size).solve_with_bounds(1e-3, ANGLE, samples, parameters=once)

    torch.testing.assert_close(found(*10 * [near]), found(near), rtol=1e-6, atol=1e-9)
    both, crowded = found(near, apart), found(*10 * [near], apart)
    torch.testing.assert_close(crowded, both, rtol=1e-6, atol=1e-9)
    assert (both - found(near)).norm() > 0.01 * both.norm()


def test_more_noise_means_less_of_it_is_followed(patch: Patch, features: Features) -> None:
    system = PatchSystem(patch, features, LENGTH, patch.size)
    misfits = []
    for noise in (1e-3, 1e-1, 1e1):
        value = rows(features, patch.points, patch.center)[0] @ system.solve(noise, 100.0)
        misfits.append(float((value - patch.value).norm()))
    assert misfits == sorted(misfits)
    assert misfits[-1] > 1.1 * misfits[0]


def test_the_smaller_system_is_solved(patch: Patch, features: Features, rng: np.random.Generator) -> None:
    many = Features.draw(89, rng, torch.zeros(0, dtype=torch.float64))
    # The patch has 20 values, 60 derivatives and 8 samples of the volume.
    assert isinstance(patch_system(patch, many, LENGTH, patch.size), LocalRowSystem)
    assert isinstance(patch_system(patch, features, LENGTH, patch.size), PatchSystem)


def test_what_rounding_makes_indefinite_is_damped_more(patch: Patch, features: Features) -> None:
    for system in (PatchSystem, LocalRowSystem):
        amplitudes = system(patch, features, LENGTH, 1e12).solve(1e-9, 1e-9)
        assert bool(torch.isfinite(amplitudes).all())


def test_the_evidence_is_the_density_of_the_data(patch: Patch, features: Features) -> None:
    """Up to what no length changes: the density of y under s^2 J J^T + D, with all matrices held whole."""
    size, count = patch.size / LocalSolveParameters.correction_rms_factor, len(patch.value)
    deviation = torch.tensor([POSITION] * count + [ANGLE] * 3 * count).double()
    y = torch.cat([patch.value, patch.gradient.reshape(-1)])

    def density(length: float) -> float:
        z = (patch.points - patch.center) @ features.frequencies.T / length + features.phases
        slopes = z.cos()[:, None, :] * features.frequencies.T / length
        J = torch.cat([z.sin(), slopes.reshape(-1, len(features))])
        covariance = size**2 * 2 / len(features) * J @ J.T + torch.diag(deviation**2)
        return float(torch.distributions.MultivariateNormal(torch.zeros_like(y), covariance).log_prob(y))

    systems = [PatchSystem(patch, features, length, patch.size) for length in (LENGTH, 2 * LENGTH)]
    one, other = (system.log_evidence(POSITION, ANGLE) for system in systems)
    assert other - one == pytest.approx(density(2 * LENGTH) - density(LENGTH), rel=1e-6)


def test_features_of_single_precision_give_nearly_the_same(patch: Patch, features: Features) -> None:
    noise = 0.3, 1.0
    exact, single = (
        PatchSystem(patch, each, LENGTH, patch.size).solve_with_bounds(*noise)
        for each in (features, features.to(torch.float32))
    )
    assert single.dtype == torch.float64
    assert 0 < float((single - exact).norm()) < 1e-4 * float(exact.norm())


def test_corrections_fade_where_no_sign_is_certain(patch: Patch) -> None:
    unbounded = torch.full_like(patch.distance, torch.inf)
    distance = torch.linspace(0.1, 9 * LENGTH, 8).to(patch.distance)
    wide = LocalSolveParameters.volume_deviation_share * distance
    film = replace(patch, lower=-unbounded, upper=unbounded, wanted=0 * patch.wanted, distance=distance)
    size = 0.01
    deviation = film.deviation(LENGTH, size)
    assert (deviation.diff() < 0).all()
    assert float(deviation[-1]) == pytest.approx(LocalSolveParameters.faded_share * size)
    # Nearer than that share of the distance they never are held, nor where a sign or a value is asked for.
    assert torch.equal(film.deviation(LENGTH, 1e3), wide)
    for other in (replace(film, lower=0 * distance), replace(film, upper=0 * distance), replace(film, wanted=distance)):
        assert torch.equal(other.deviation(LENGTH, size), wide)
