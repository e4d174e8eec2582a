"""Local PCA against a singular value decomposition, and its coordinates and shares on shapes that are known."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.geometry.local_pca import (
    plane_normals,
    principal_axes,
    principal_sums,
    quadric_terms,
    surface_variation,
    tangent_coordinates,
)


def test_axes_and_eigenvalues_are_those_of_a_singular_value_decomposition(rng: np.random.Generator) -> None:
    groups = rng.normal(size=(20, 12, 3)) * [1.0, 0.5, 0.1]
    sums, axes = principal_axes(groups)
    for group, values, columns, normal in zip(groups, sums, axes, plane_normals(groups), strict=True):
        _, sizes, rows = np.linalg.svd(group - group.mean(axis=0))
        np.testing.assert_allclose(values[::-1], sizes**2)
        np.testing.assert_allclose(np.abs(np.diag(rows[::-1] @ columns)), 1)
        assert abs(normal @ rows[2]) == pytest.approx(1)
    np.testing.assert_allclose(principal_sums(groups), sums)
    np.testing.assert_allclose(principal_axes(groups, covariance=True)[0], sums / 12)


def test_surface_variation_of_a_plane_of_a_ball_and_of_one_point(rng: np.random.Generator) -> None:
    ball = rng.normal(size=(1, 4000, 3))
    groups = np.concatenate([ball * [1, 1, 0], ball, 0 * ball + 5])
    assert surface_variation(groups) == pytest.approx([0, 1 / 3, 0], abs=0.02)


def test_tangent_coordinates_keep_distances_in_units_of_the_reach(rng: np.random.Generator) -> None:
    groups = 7 + rng.normal(size=(10, 9, 3)) * [3.0, 1.0, 0.01]
    local = tangent_coordinates(groups)
    reach = np.linalg.norm(groups - groups[:, :1], axis=2).max(axis=1)
    between, before = (np.linalg.norm(x[:, :, None] - x[:, None], axis=3) for x in (local, groups))
    np.testing.assert_allclose(between * reach[:, None, None], before, atol=1e-12)
    np.testing.assert_array_equal(local[:, 0], 0)
    spread = local.var(axis=1)
    assert (spread[:, 0] > spread[:, 1]).all()
    assert (spread[:, 1] > spread[:, 2]).all()
    assert (tangent_coordinates(np.zeros((1, 5, 3))) == 0).all()


def test_terms_of_a_quadric() -> None:
    terms = quadric_terms(np.array([[2.0]]), np.array([[3.0]]))
    assert terms.tolist() == [[[1, 2, 3, 4, 6, 9]]]
