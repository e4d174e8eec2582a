"""Length scale and noise by validation points: what is tried, and what each scan allows."""

from __future__ import annotations

from dataclasses import replace

import made_shapes
import numpy as np
import pytest

from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.marginal_likelihood import MarginalLikelihood
from gnrecon.fit.model_selection import CrossValidation, select_hyperparameters


def test_the_noise_of_estimated_normals_is_about_that_of_the_points() -> None:
    points = made_shapes.sphere(500, np.random.default_rng(0))[0]
    residuals = FieldResiduals(points, points, np.full(500, 0.05), points, estimated=True, noise=0.03)
    held_out = np.arange(500) % 8 == 0
    for known, least, most in ((0.03, 0.015, 0.06), (None, 0.0, 0.051)):
        of_points = replace(residuals, noise=known)
        validation = CrossValidation.draw(of_points, held_out, 0.1, np.random.default_rng(0), "cpu")
        positions = [position for position, _ in validation.noises(0.4)]
        assert least <= min(positions)
        assert max(positions) <= most
    assert min(positions) < 0.015


@pytest.mark.parametrize("outliers", [False, True])
def test_outliers_leave_the_choice_to_validation_points(monkeypatch: pytest.MonkeyPatch, outliers: bool) -> None:
    """The marginal likelihood is not robust to those that remain; nor is the scan fitted as a clean one."""
    rng = np.random.default_rng(0)
    points, normals = made_shapes.sphere(400, rng, 0.8, 0.02)
    value, held_out = np.linalg.norm(points, axis=1) - 0.8, np.arange(400) % 6 == 0
    residuals = FieldResiduals(points, normals, value, points / np.linalg.norm(points, axis=1, keepdims=True))
    likely = 0.123 * residuals.density.radius
    monkeypatch.setattr(MarginalLikelihood, "likeliest", lambda *_: (likely, 0.2))
    chosen = select_hyperparameters(residuals, held_out, residuals.density.radius, rng, outliers=outliers)
    assert chosen.by_place is not outliers
    assert chosen.robust is outliers
    assert (chosen.position == likely) is not outliers


@pytest.mark.parametrize(("count", "patches"), [(60, 10), (1000, 16), (4000, 66)])
def test_patches_predict_each_validation_point_twice(count: int, patches: int) -> None:
    rng = np.random.default_rng(0)
    points, normals = made_shapes.sphere(count, rng, 0.8)
    residuals = FieldResiduals(points, normals, np.full(count, 0.01), normals)
    held_out = np.arange(count) % 6 == 0
    validation = CrossValidation.draw(residuals, held_out, residuals.density.radius, rng, "cpu")
    assert len(validation.predicted) == patches
    assert all(held_out[rows].all() for rows in validation.predicted)
    # With the likeliest noise no other is tried.
    assert len(validation.noises(0.4)) == 1


@pytest.mark.parametrize(
    ("means", "tried"),
    [
        ({2.8: 1.2, 4.0: 1.0, 5.6: 0.9, 8.0: 0.8, 11.3: 0.81, 16.0: 0.5}, {4.0, 5.6, 8.0, 11.3}),
        ({2.8: 1.2, 4.0: 1.0, 5.6: 0.9, 8.0: 0.8999, 11.3: 0.5}, {4.0, 5.6, 8.0}),
        ({2.0: 0.7, 2.8: 0.8, 4.0: 1.0, 5.6: 1.1}, {5.6, 4.0, 2.8, 2.0}),
    ],
)
def test_the_search_ends_where_the_next_length_is_better_by_chance_alone(
    monkeypatch: pytest.MonkeyPatch, means: dict[float, float], tried: set[float]
) -> None:
    rng = np.random.default_rng(0)
    points, normals = made_shapes.sphere(1000, rng, 0.8)
    residuals = FieldResiduals(points, normals, np.full(1000, 0.01), normals)
    validation = CrossValidation.draw(residuals, np.arange(1000) % 6 == 0, 1.0, rng, "cpu")
    asked: set[float] = set()

    def scores(self: CrossValidation, length: float) -> np.ndarray:
        del self
        asked.add(length)
        # Patch by patch, a difference of two lengths is at least a thousandth off its mean.
        return means[length] + 0.01 * np.sin(length * np.arange(16))[:, None]

    monkeypatch.setattr(CrossValidation, "scores", scores)
    monkeypatch.setattr(CrossValidation, "noises", lambda *_: [(0.01, 0.1)])
    validation.select()
    assert asked == tried
