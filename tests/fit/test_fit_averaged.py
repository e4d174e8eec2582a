"""Whether points are averaged is chosen by left-out points: for noisy edges, not for smooth or clean shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gnrecon.cloud import Frame, Samples
from gnrecon.fit import FitOptions, NeuralSDF, averaged, fit
from gnrecon.fit.averaged import NOISY, Told, told

FRAME = Frame(np.array([10.0, -20.0, 30.0]), 2.0)


class Rounded:
    """What a smooth field knows of a cube or, with exponent 2, of a ball: |x|_p - 0.8, in the frame."""

    def __init__(self, exponent: float) -> None:
        self.exponent = exponent

    def sdf_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, p = FRAME.to_unit(points), self.exponent
        norm = (np.abs(x) ** p).sum(axis=1) ** (1 / p)
        gradient = np.sign(x) * (np.abs(x) / norm[:, None]) ** (p - 1)
        return (norm - 0.8) * FRAME.scale, gradient


def cube(count: int, noise: float, rng: np.random.Generator) -> Samples:
    axis, side, rows = rng.integers(3, size=count), rng.choice([-1.0, 1.0], count), np.arange(count)
    x, normals = rng.uniform(-0.8, 0.8, (count, 3)), np.zeros((count, 3))
    x[rows, axis] = 0.8 * side + noise * rng.standard_normal(count)
    normals[rows, axis] = side
    return Samples(x, normals, FRAME)


def ball(count: int, noise: float, rng: np.random.Generator) -> Samples:
    x = rng.standard_normal((count, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return Samples(x * (0.8 + noise * rng.standard_normal((count, 1))), x, FRAME)


def found(samples: Samples, exponent: float) -> Told:
    rng = np.random.default_rng(1)
    held = rng.random(len(samples)) < 0.15
    field: NeuralSDF = Rounded(exponent)  # type: ignore[assignment]
    return told(field, samples, held, rng, "cpu")


def off_cube(x: np.ndarray) -> np.ndarray:
    outside = np.abs(x) - 0.8
    return np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0))


def test_noisy_points_of_a_cube_are_averaged() -> None:
    samples = cube(1200, 0.01, np.random.default_rng(2))
    result = found(samples, 8.0)
    assert result.averaging is not None
    assert off_cube(result.samples.points).mean() < 0.5 * off_cube(samples.points).mean()
    np.testing.assert_array_equal(result.leftover.points, result.samples.points)
    # What is left to be averaged by the fit is less.
    raw = off_cube(samples.points).mean()
    assert result.belief.position < raw


def test_noisy_points_of_a_ball_are_not() -> None:
    samples = ball(1200, 0.015, np.random.default_rng(3))
    result = found(samples, 2.0)
    assert result.belief.position > NOISY * result.leftover.density.radius
    assert result.averaging is None
    assert result.samples is samples


def test_clean_points_and_estimated_normals_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise AssertionError("tried")

    monkeypatch.setattr(averaged, "_best", refused)
    assert found(cube(1200, 0.0, np.random.default_rng(4)), 8.0).averaging is None
    noisy = replace(cube(1200, 0.01, np.random.default_rng(4)), estimated=True)
    assert found(noisy, 8.0).averaging is None


def test_a_fit_says_how_it_averaged() -> None:
    """The whole of it: the edges of a noisy cube come out sharper than its points are."""
    samples = cube(1200, 0.015, np.random.default_rng(5))
    sdf, solution = fit(samples, FitOptions(quality="draft"))
    assert "Averaged noisy points" in solution.status
    exact = cube(2000, 0.0, np.random.default_rng(6))
    errors = np.abs(sdf.sdf(FRAME.to_world(exact.points))) / FRAME.scale
    assert errors.mean() < 0.4 * off_cube(samples.points).mean()
