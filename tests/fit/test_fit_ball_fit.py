"""Scans of a ball are projected onto it, and those of other shapes are not, however similar to a ball they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gnrecon.fit import FitOptions, fit
from gnrecon.fit.shape_priors.ball_fit import BallFit
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples

FRAME = Frame(np.array([5e5, 4.5e6, 100.0]), 20.0)
CENTER, RADIUS = np.array([0.1, -0.05, 0.02]), 0.8


def directions(count: int, seed: int) -> Float:
    x = np.random.default_rng(seed).standard_normal((count, 3))
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))


def scan(count: int, noise: float = 0.0, tilt: float = 0.0, seed: int = 0) -> Samples:
    rng, outward = np.random.default_rng(seed + 100), directions(count, seed)
    normals = outward + tilt * rng.standard_normal((count, 3))
    points = CENTER + RADIUS * outward + noise * rng.standard_normal((count, 3))
    return Samples(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), FRAME)


def spoiled(count: int, by: Float, seed: int = 0) -> Samples:
    """Points of a ball moved along their normals, by an array of shape (count,)."""
    samples = scan(count, seed=seed)
    return replace(samples, points=samples.points + by[:, None] * samples.normals)


def off(samples: Samples) -> Float:
    return np.asarray(np.linalg.norm(samples.points - CENTER, axis=1) - RADIUS)


@pytest.mark.parametrize(("count", "noise", "tilt", "most"), [(60, 0.0, 0.0, 1e-9), (2000, 0.008, 0.3, 1e-3)])
def test_points_of_a_ball_are_projected_onto_it_and_its_gaps_are_filled(
    count: int, noise: float, tilt: float, most: float
) -> None:
    whole = scan(count, noise, tilt)
    for samples in (whole, replace(whole, estimated=True)):
        ball = BallFit.of(samples)
        assert ball is not None
        assert ball.radius == pytest.approx(RADIUS * FRAME.scale, rel=most)
        assert not ball.samples.estimated
        assert np.abs(off(ball.samples)).max() < most
        outward = (ball.samples.points - CENTER) / RADIUS
        assert np.linalg.norm(outward - ball.samples.normals, axis=1).max() < 3 * most
        # The scan's come first, each where it was, but for the noise; no place is far from all.
        moved = np.linalg.norm(ball.samples.points[:count] - samples.points, axis=1)
        assert moved.max() < 6 * noise + 1e-9
        places = CENTER + RADIUS * directions(5000, 9)
        gaps = np.linalg.norm(places[:, None] - ball.samples.points[None], axis=2).min(axis=1)
        assert gaps.max() < 2 * np.sqrt(4 * np.pi / max(count, 1000)) * RADIUS


def test_shapes_that_are_nearly_balls_are_left_alone() -> None:
    count = 500
    outward = directions(count, 0)
    longer = 0.003 * (3 * outward[:, 2] ** 2 - 1)
    rippled = 0.003 * np.sin(6 * outward[:, 0]) * np.sin(6 * outward[:, 1])
    bump = 0.01 * np.exp(-40 * (1 - outward[:, 2]))
    noise = 0.001 * np.random.default_rng(1).standard_normal(count)
    for by in (longer, rippled, bump):
        assert BallFit.of(spoiled(count, by)) is None
        assert BallFit.of(spoiled(count, by + noise)) is None
    assert BallFit.of(spoiled(count, noise)) is not None


def test_what_may_go_on_as_another_shape_is_left_alone() -> None:
    ball = scan(800)
    dome = ball.points[:, 2] > CENTER[2]
    assert BallFit.of(replace(ball, points=ball.points[dome], normals=ball.normals[dome])) is None
    holed = ball.points[:, 2] < CENTER[2] + 0.9 * RADIUS
    assert BallFit.of(replace(ball, points=ball.points[holed], normals=ball.normals[holed])) is not None
    stick = np.stack([np.zeros(20), np.zeros(20), np.linspace(0.85, 1.2, 20)], axis=1)
    on_a_stick = np.concatenate([ball.points, CENTER + stick]), np.concatenate([ball.normals, np.eye(3)[[0] * 20]])
    assert BallFit.of(replace(ball, points=on_a_stick[0], normals=on_a_stick[1])) is None
    assert BallFit.of(replace(ball, normals=-ball.normals)) is None
    assert BallFit.of(scan(20)) is None
    assert BallFit.of(scan(800, noise=0.1)) is None
    flat = ball.points * [1.0, 1.0, 0.0]
    assert BallFit.of(replace(ball, points=flat)) is None


def test_the_fit_of_few_points_of_a_ball_is_a_ball() -> None:
    sdf, solution = fit(scan(80), FitOptions(quality="draft"))
    places = FRAME.to_world(CENTER + RADIUS * directions(2000, 3))
    assert np.abs(sdf.sdf(places)).max() < 2e-5 * FRAME.scale
    assert "Snapped 80 points to a ball of radius 16. Filled gaps of the ball with" in solution.status
    # A curvature penalty decides how the surface goes on between the points.
    _, smoothed = fit(scan(80), FitOptions(quality="draft", smooth="strain=1e-6"))
    assert "ball" not in smoothed.status


def test_normals_of_a_ball_are_known_however_unsure_they_were() -> None:
    unsure = replace(scan(80), estimated=True, clean=True, deviations=np.full(80, 0.2))
    ball = BallFit.of(unsure)
    assert ball is not None
    assert ball.samples.deviations is None
    assert not ball.samples.estimated
    places = FRAME.to_world(CENTER + RADIUS * directions(2000, 3))
    assert np.abs(fit(unsure, FitOptions(quality="draft"))[0].sdf(places)).max() < 2e-5 * FRAME.scale
