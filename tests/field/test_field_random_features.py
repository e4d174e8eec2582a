"""Random sine features: their spectrum, and how evenly they fill it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import kv

from gnrecon.field.field_parameters import FieldParameters
from gnrecon.field.random_features import Features

LIKE = torch.zeros(0, dtype=torch.float64)


def matern(distance: np.ndarray, degrees_of_freedom: float) -> np.ndarray:
    """Matern's covariance of smoothness nu / 2 and a length of one; nu is even."""
    smoothness = degrees_of_freedom / 2
    s = np.sqrt(2 * smoothness) * np.maximum(distance, 1e-9)
    found: np.ndarray = 2 ** (1 - smoothness) / np.prod(np.arange(1, smoothness)) * s**smoothness * kv(smoothness, s)
    return found


@pytest.mark.parametrize("degrees_of_freedom", [4.0, FieldParameters.degrees_of_freedom])
def test_the_spectrum_is_that_of_a_matern_kernel(degrees_of_freedom: float) -> None:
    """The kernel E[2 sin(F.x + p) sin(F.y + p)] = E[cos F.(x - y)] is Matern's, of smoothness nu / 2."""
    features = Features.draw(200_000, np.random.default_rng(0), LIKE, degrees_of_freedom=degrees_of_freedom)
    frequencies, phases = features.frequencies, features.phases
    assert frequencies.shape == (200_000, 3)
    assert float(phases.min()) >= 0.0
    assert float(phases.max()) <= 2 * np.pi
    for distance in (0.4, 1.0, 2.5):
        offset = distance * torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)
        expected = float(matern(np.array(distance), degrees_of_freedom))
        assert float(torch.cos(frequencies @ offset).mean()) == pytest.approx(expected, abs=4 / np.sqrt(200_000))
        sines = 2 * torch.sin(phases) * torch.sin(phases + frequencies @ offset)
        assert float(sines.mean()) == pytest.approx(expected, abs=6 / np.sqrt(200_000))


@pytest.mark.parametrize("count", [300, 600])
def test_they_are_nearer_to_the_kernel_than_independent_ones(count: int) -> None:
    """Also the first of more features are."""
    x = np.random.default_rng(5).uniform(-1.5, 1.5, (100, 3))
    exact = matern(np.linalg.norm(x[:, None] - x, axis=2), FieldParameters.degrees_of_freedom)
    center = torch.zeros(3, dtype=torch.float64)

    def error(features: Features) -> float:
        sines = features.phase(torch.as_tensor(x), center, 1.0).sin()
        return float(np.sqrt(np.mean((2.0 / len(features) * (sines @ sines.T).numpy() - exact) ** 2)))

    def independent(seed: int) -> Features:
        rng, freedom = np.random.default_rng(seed), FieldParameters.degrees_of_freedom
        spread = np.sqrt(rng.chisquare(freedom, count) / freedom)
        frequencies = rng.standard_normal((count, 3)) / spread[:, None]
        return Features(torch.as_tensor(frequencies), torch.as_tensor(rng.uniform(0.0, 2 * np.pi, count)))

    seeds = range(8)
    by_chance = np.mean([error(independent(seed)) for seed in seeds])
    even = [Features.draw(count, np.random.default_rng(seed), LIKE) for seed in seeds]
    first = [Features.draw(1000, np.random.default_rng(seed), LIKE).first(count) for seed in seeds]
    assert np.mean([error(features) for features in even]) < 0.65 * by_chance
    assert np.mean([error(features) for features in first]) < 0.65 * by_chance


def test_a_draw_depends_on_its_generator_alone() -> None:
    one, same, other = (Features.draw(50, np.random.default_rng(seed), LIKE) for seed in (3, 3, 4))
    assert torch.equal(one.frequencies, same.frequencies)
    assert torch.equal(one.phases, same.phases)
    assert not torch.equal(one.frequencies, other.frequencies)
