"""The global field: its length long for shapes of few degrees of freedom, its normals worth what they are exact."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.fit.linear_field import Smoothness, field_smoothness
from gnrecon.fit.objective import Scene
from gnrecon.fit.parameters import LinearFieldParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples

FRAME = Frame(np.zeros(3), 1.0)


def rippled(ripples: float, height: float, noise: float) -> Samples:
    """Points of a sphere of radius 0.8 with ripples, moved along their normals by noise."""
    rng = np.random.default_rng(0)

    def level(x: Float) -> tuple[Float, Float]:
        radius, (sx, sy), (cx, cy) = (
            np.linalg.norm(x, axis=1),
            np.sin(ripples * x[:, :2]).T,
            np.cos(ripples * x[:, :2]).T,
        )
        turn = height * ripples * np.stack([cx * sy, sx * cy, 0 * sx], axis=1)
        return radius - 0.8 - height * sx * sy, x / radius[:, None] - turn

    x = rng.standard_normal((1500, 3))
    x *= 0.8 / np.linalg.norm(x, axis=1, keepdims=True)
    for _ in range(30):
        value, gradient = level(x)
        x -= (value / np.einsum("ij,ij->i", gradient, gradient))[:, None] * gradient
    normals = level(x)[1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Samples(x + noise * rng.standard_normal((1500, 1)) * normals, normals, FRAME)


def chosen(samples: Samples) -> Smoothness:
    held = np.zeros(len(samples), dtype=bool)
    held[::6] = True
    seen = Samples(samples.points[~held], samples.normals[~held], FRAME)
    scene = Scene.of(seen, "cpu", np.random.default_rng(1))
    return field_smoothness(samples, held, scene, np.random.default_rng(2))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_ball_needs_long_features(noise: float) -> None:
    assert chosen(rippled(1.0, 0.0, noise)).length > LinearFieldParameters.length_scales_radii[0]


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_ripples_need_short_features(noise: float) -> None:
    assert chosen(rippled(9.0, 0.05, noise)).length == LinearFieldParameters.length_scales_radii[0]


def test_equal_seeds_choose_alike() -> None:
    samples = rippled(4.0, 0.05, 0.003)
    assert chosen(samples) == chosen(samples)


def test_exact_normals_of_a_smooth_shape_reach_farther_than_scattered_ones() -> None:
    exact = rippled(1.0, 0.0, 0.01)
    turned = exact.normals + 0.5 * np.random.default_rng(3).standard_normal(exact.normals.shape)
    scattered = Samples(exact.points, turned / np.linalg.norm(turned, axis=1, keepdims=True), FRAME)
    assert chosen(exact).reach == LinearFieldParameters.normal_reaches_spacings[-1]
    assert chosen(scattered).reach < LinearFieldParameters.normal_reaches_spacings[-1]
