"""Patches of normals on the wrong side are turned around; right ones, thin walls' too, stay."""

from __future__ import annotations

from dataclasses import replace

import made_shapes
import numpy as np
import pytest

from gnrecon.fit.consistency import flip_contradicted_normals, without_smooth_patches
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.two_level import fit_two_level
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples

OPTIONS = FitOptions(quality="draft")


def sphere(count: int, rng: np.random.Generator) -> Samples:
    return Samples(*made_shapes.sphere(count, rng, 0.9), Frame(np.array([5.0, 0, -3]), 2.0))


def plate(count: int, rng: np.random.Generator) -> Samples:
    """Both sides of a disk, as far from each other as its points are."""
    angles, radii = 2 * np.pi * rng.uniform(size=count), 0.9 * np.sqrt(rng.uniform(size=count))
    sides = rng.choice([-1.0, 1.0], count)
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles), 0.04 * sides], axis=1)
    return Samples(points, np.stack([0 * sides, 0 * sides, sides], axis=1), Frame(np.zeros(3), 1.0))


def turned(samples: Samples, patch: Float) -> Samples:
    return replace(samples, normals=np.where(patch[:, None], -samples.normals, samples.normals), estimated=True)


def test_a_patch_on_the_wrong_side_is_turned_around(rng: np.random.Generator) -> None:
    right = sphere(900, rng)
    patch = np.linalg.norm(right.points - right.points[0], axis=1) < 0.15
    assert 2 < patch.sum() < 20
    found, share = flip_contradicted_normals(turned(right, patch), np.arange(900), OPTIONS)
    assert np.array_equal(found.normals, right.normals)
    assert share == pytest.approx(patch.mean())


@pytest.mark.parametrize("shape", [sphere, plate])
def test_right_normals_stay(shape: type, rng: np.random.Generator) -> None:
    right = shape(900, rng)
    found, share = flip_contradicted_normals(right, np.arange(900), OPTIONS)
    assert np.array_equal(found.normals, right.normals)
    assert share == 0


def test_a_patch_that_continues_its_surroundings_stays(rng: np.random.Generator) -> None:
    # A gentle hill, of which a corner and a patch in the middle are in question.
    flat = rng.uniform(-0.6, 0.6, (900, 2))
    normals = np.column_stack([0.3 * np.sin(2 * flat), np.ones(900)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    height = 0.15 * np.cos(2 * flat).sum(axis=1)
    right = Samples(np.column_stack([flat, height]), normals, Frame(np.zeros(3), 1.0))
    corner, middle = (flat > 0.45).all(axis=1), np.linalg.norm(flat, axis=1) < 0.1
    assert corner.any()
    assert middle.any()
    assert not without_smooth_patches(right, corner | middle).any()
    assert np.array_equal(without_smooth_patches(turned(right, middle), corner | middle), middle)


def test_the_default_fit_turns_estimates(rng: np.random.Generator) -> None:
    # An egg: what its normals are, the points of a ball would tell by themselves.
    ball = sphere(250, rng)
    normals = ball.normals / [1.0, 1.0, 0.8]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    right = replace(ball, points=ball.points * [1.0, 1.0, 0.8], normals=normals)
    wrong = turned(right, np.linalg.norm(right.points - right.points[0], axis=1) < 0.3)
    status = fit_two_level(wrong, OPTIONS, np.random.default_rng(0))[1].status
    assert "of the normals around: a first field contradicts them." in status
