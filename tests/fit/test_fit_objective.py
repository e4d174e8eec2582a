"""The fit's least-squares problem against its definition: nested autodiff of every weighted residual."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm, groups
from gnrecon.residuals import (
    eikonal,
    interface,
    normal_cosine,
    normal_projection,
    normal_vector,
    signed_distance,
)

seeds = given(seed=st.integers(0, 2**32 - 1))
few = settings(max_examples=3, deadline=None)


def value_at(field: Siren, theta: Tensor, x: Tensor) -> Tensor:
    """The field at one point of shape (3,)."""
    *hidden, (weights, bias) = field.layout.layers(theta)
    activation = x
    for W, b in hidden:
        activation = torch.sin(W @ activation + b)
    return (weights @ activation + bias)[0]


def plain_residuals(field: Siren, terms: Sequence[ObjectiveTerm], theta: Tensor) -> list[Tensor]:
    """Unweighted residuals of each term, of shape (N, m)."""
    results = []
    for term in terms:
        value = vmap(lambda x: value_at(field, theta, x))(term.points)
        gradient = vmap(grad(lambda x: value_at(field, theta, x)))(term.points)
        results.append(term.residual(value, gradient, term.target).residual)
    return results


def weighted(field: Siren, terms: Sequence[ObjectiveTerm], theta: Tensor) -> Tensor:
    rows = []
    for term, residual in zip(terms, plain_residuals(field, terms, theta), strict=True):
        weight = torch.as_tensor(term.weight, dtype=theta.dtype).expand(len(term))
        rows.append((torch.sqrt(weight / len(term))[:, None] * residual).flatten())
    return torch.cat(rows)


def draw(seed: int, widths: tuple[int, ...]) -> tuple[Siren, list[ObjectiveTerm], Tensor, torch.Generator]:
    """All kinds of terms: on shared and on own points, with and without targets, weighted as one and by point."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    on, around, volume = normal(150, 3), normal(70, 3), normal(90, 3)
    normals = on / on.norm(dim=1, keepdim=True)
    side = around / around.norm(dim=1, keepdim=True)
    by_point = 0.1 + torch.rand(150, generator=generator, dtype=torch.float64)
    terms = [
        ObjectiveTerm("interface", interface, on),
        ObjectiveTerm("distance", signed_distance, volume, normal(90), 0.3),
        ObjectiveTerm("normal", normal_vector, on, normals, by_point),
        ObjectiveTerm("eikonal", eikonal, around, None, 0.01),
        ObjectiveTerm("cosine", normal_cosine, on, normals, 2.0 * by_point),
        ObjectiveTerm("projection", normal_projection, around, side, 0.7),
    ]
    field = Siren(widths)
    return field, terms, normal(field.layout.count), generator


def in_order(rows: Tensor) -> Tensor:
    """Rows sorted by their first column, because they come point group by point group."""
    return rows[rows[:, 0].argsort()]


def collect(problem: FieldProblem, free: Tensor) -> Tensor:
    """Residuals, in the first column, and Jacobian rows beside them."""
    jacobian, residual = problem.linearise(free)
    rows = torch.cat([chunk.clone() for chunk in jacobian.dense()])
    return torch.cat([residual[:, None], rows.to(residual)], dim=1)


@pytest.mark.parametrize("widths", [(6,), (5, 4)], ids=str)
@pytest.mark.parametrize("keep_bytes", [0, 1_000_000_000], ids=["remade", "kept"])
@pytest.mark.parametrize("precision", [None, torch.float32], ids=str)
@few
@seeds
@example(seed=60162)  # a gradient of 0.3 beside second derivatives of 36
def test_rows_are_the_jacobian(
    widths: tuple[int, ...], keep_bytes: int, precision: torch.dtype | None, seed: int
) -> None:
    field, terms, theta, generator = draw(seed, widths)
    problem = FieldProblem(field, terms, theta, keep_bytes=keep_bytes, precision=precision)
    residual = weighted(field, terms, theta)
    jacobian = jacrev(lambda theta: weighted(field, terms, theta))(theta)
    oracle = torch.cat([residual[:, None], jacobian], dim=1)
    close = 1e-9 if precision is None else 1e-4
    expected = in_order(oracle)
    error = (in_order(collect(problem, theta)) - expected).abs() / (1.0 + expected.abs())
    assert float(error.quantile(0.999)) < close
    # Single precision loses digits of the cosine's few rows where the gradient is small.
    assert float(error.max()) < (close if precision is None else 1e-2)
    # The residuals are never in the lower precision.
    operator, found = problem.linearise(theta)
    torch.testing.assert_close(found, problem.residual(theta), rtol=0.0, atol=0.0)
    # Products come out the same however often the rows are made.
    u = torch.randn(len(found), generator=generator, dtype=torch.float64)
    assert torch.equal(operator.tmv(u), operator.tmv(u))
    rows = torch.cat([chunk.clone() for chunk in operator.dense()]).double()
    torch.testing.assert_close(operator.tmv(u), rows.T @ u, rtol=close, atol=close)


@pytest.mark.parametrize("widths", [(6,), (5, 4)], ids=str)
@few
@seeds
def test_rows_of_some_units(widths: tuple[int, ...], seed: int) -> None:
    field, terms, theta, generator = draw(seed, widths)
    chosen = torch.randperm(widths[0], generator=generator)[:3]
    problem = FieldProblem(field, terms, theta, (chosen, *(None for _ in widths)))
    columns = field.layout.columns(problem.units or ())
    # Away from where the problem was posed, as the trials of a search are.
    free = problem.free() + 0.1 * torch.randn(len(columns), generator=generator, dtype=torch.float64)
    whole = theta.clone()
    whole[columns] = free
    residual = weighted(field, terms, whole)
    jacobian = jacrev(lambda theta: weighted(field, terms, theta))(whole)[:, columns]
    oracle = torch.cat([residual[:, None], jacobian], dim=1)
    torch.testing.assert_close(in_order(collect(problem, free)), in_order(oracle), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(problem.residual(free).sort().values, residual.sort().values, rtol=1e-9, atol=1e-9)


@few
@seeds
def test_loss_is_the_papers_monte_carlo_sum(seed: int) -> None:
    """Half the sum over terms of weight times mean square, mean over points and sum over a point's residuals."""
    field, terms, theta, _ = draw(seed, (6, 5))
    loss = 0.0
    for term, residual in zip(terms, plain_residuals(field, terms, theta), strict=True):
        weights = torch.as_tensor(term.weight, dtype=theta.dtype).expand(len(term))
        loss += sum(float(w * (row @ row)) for w, row in zip(weights, residual, strict=True)) / (2 * len(term))
    problem = FieldProblem(field, terms, theta)
    residual = problem.residual(theta)
    assert 0.5 * float(residual @ residual) == pytest.approx(loss, rel=1e-10)


def test_free_and_whole_are_inverse_and_leave_the_rest() -> None:
    field, terms, theta, _ = draw(0, (6, 5))
    everything = FieldProblem(field, terms, theta)
    assert torch.equal(everything.whole(everything.free()), theta)
    problem = FieldProblem(field, terms, theta, (torch.tensor([4, 1]), torch.tensor([0]), None))
    assert torch.equal(problem.whole(problem.free()), theta)
    kept = theta.clone()
    moved = problem.whole(problem.free() + 1.0)
    changed = (moved != theta).nonzero().flatten()
    # Two units of three inputs and a bias, one of six and a bias, the output with five weights and a bias.
    assert len(changed) == 2 * 4 + 1 * 7 + 6
    assert torch.equal(theta, kept), "the problem's own parameters stay"


def test_long_lists_of_points_are_evaluated_in_parts() -> None:
    field, _, theta, generator = draw(3, (4,))
    x = torch.randn(9001, 3, generator=generator, dtype=torch.float64)
    value, gradient = field.value_and_gradient(theta, x)
    values_only = FieldProblem(field, [ObjectiveTerm("interface", interface, x)], theta)
    torch.testing.assert_close(values_only.residual(theta), value / 9001**0.5)
    with_gradient = FieldProblem(field, [ObjectiveTerm("eikonal", eikonal, x)], theta)
    torch.testing.assert_close(with_gradient.residual(theta), (gradient.norm(dim=1) - 1) / 9001**0.5)


def test_terms_are_grouped_by_their_tensor_of_points() -> None:
    _, terms, _, _ = draw(0, (4,))
    names = [[term.name for term in group] for group in groups(terms)]
    assert names == [["interface", "normal", "cosine"], ["distance"], ["eikonal", "projection"]]
