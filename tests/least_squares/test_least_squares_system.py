"""Metrics against their definitions."""

from __future__ import annotations

import torch
from damped_problems import layered

from gnrecon.least_squares import DenseJacobian, identity, jacobian_layer_scaled, jacobian_scaled, layer_scaled


def test_identity_is_one_everywhere() -> None:
    jacobian, J = layered(0)
    assert torch.equal(identity(jacobian), torch.ones(J.shape[1], dtype=J.dtype))


def test_jacobian_scaled_is_the_diagonal_with_a_floor() -> None:
    jacobian, J = layered(1)
    torch.testing.assert_close(jacobian_scaled(jacobian), J.square().sum(0))
    J[:, 3] = 0.0
    metric = jacobian_scaled(DenseJacobian(J))
    assert 0.0 < float(metric[3]) <= 1e-11 * float(metric.max())


def test_layer_scaled_is_the_mean_of_each_layer() -> None:
    jacobian, J = layered(2, units=((1,), None))
    metric, diagonal = layer_scaled(jacobian), J.square().sum(0)
    for group in jacobian.groups:
        torch.testing.assert_close(metric[group], diagonal[group].mean().expand_as(metric[group]))


def test_jacobian_layer_scaled_adds_a_tenth_of_the_layer_to_the_diagonal() -> None:
    jacobian, J = layered(4, units=((1,), None))
    metric, diagonal = jacobian_layer_scaled(jacobian), J.square().sum(0)
    for group in jacobian.groups:
        torch.testing.assert_close(metric[group], diagonal[group] + 0.1 * diagonal[group].mean())


def test_metrics_are_positive_where_there_is_nothing() -> None:
    for jacobian in (
        DenseJacobian(torch.zeros(5, 3)),
        DenseJacobian(torch.zeros(0, 3, dtype=torch.float64)),
        DenseJacobian(torch.zeros(5, 0)),
        layered(3, units=((), None))[0],
        layered(3, units=((), ()))[0],
    ):
        for metric in (identity, jacobian_scaled, layer_scaled, jacobian_layer_scaled):
            D = metric(jacobian)
            assert D.shape == (jacobian.columns,)
            assert D.dtype == jacobian.dtype
            assert bool((D > 0.0).all())
            assert bool(torch.isfinite(D).all())
