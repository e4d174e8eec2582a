"""The start's linear solve is optimal, and its random features have the spectrum that they claim."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gnrecon.field import Siren
from gnrecon.fit import initialisation
from gnrecon.fit.initialisation import LastLayer, solve_last_layer
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm
from gnrecon.residuals import interface, normal_vector, signed_distance
from gnrecon.runtime.errors import FitError

each_field = pytest.mark.parametrize("widths", [(20,), (12, 15)], ids=str)


def draw(widths: tuple[int, ...]) -> tuple[Siren, list[ObjectiveTerm], Tensor]:
    generator = torch.Generator().manual_seed(4)
    field = Siren(widths)
    x, volume = (torch.randn(count, 3, generator=generator, dtype=torch.float64) for count in (60, 80))
    normals = x / x.norm(dim=1, keepdim=True)
    terms = [
        ObjectiveTerm("interface", interface, normals),
        ObjectiveTerm("normal", normal_vector, normals, normals, 0.3),
        ObjectiveTerm("distance", signed_distance, volume, volume.norm(dim=1) - 1, 0.1),
    ]
    return field, terms, torch.randn(field.layout.count, generator=generator, dtype=torch.float64)


def loss_gradient(field: Siren, terms: list[ObjectiveTerm], theta: Tensor) -> tuple[float, Tensor]:
    """The loss and its gradient by the last layer's parameters."""
    problem = FieldProblem(field, terms, theta)
    jacobian, residual = problem.linearise(theta)
    return 0.5 * float(residual @ residual), jacobian.tmv(residual)[field.layout.offsets[-1] :]


@each_field
def test_solve_is_optimal_in_the_last_layer(widths: tuple[int, ...]) -> None:
    field, terms, theta = draw(widths)
    solved = solve_last_layer(field, terms, theta)
    before, slope = loss_gradient(field, terms, theta)
    after, flat = loss_gradient(field, terms, solved)
    last = field.layout.offsets[-1]
    assert torch.equal(solved[:last], theta[:last])
    assert after < before
    # The ridge leaves a gradient of its own size.
    assert float(flat.norm()) < 1e-7 * float(slope.norm())
    generator = torch.Generator().manual_seed(5)
    for _ in range(5):
        other = solved.clone()
        other[last:] += 1e-2 * torch.randn(len(other) - last, generator=generator, dtype=other.dtype)
        assert loss_gradient(field, terms, other)[0] > after


@each_field
def test_solve_finds_a_field_that_the_features_can_express(widths: tuple[int, ...]) -> None:
    field, _, theta = draw(widths)
    x = torch.randn(200, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    value, gradient = field.value_and_gradient(theta, x)
    terms = [ObjectiveTerm("distance", signed_distance, x, value), ObjectiveTerm("normal", normal_vector, x, gradient)]
    blank = theta.clone()
    blank[field.layout.offsets[-1] :] = 0.0
    torch.testing.assert_close(solve_last_layer(field, terms, blank), theta, rtol=0, atol=1e-4)


def test_equations_add_and_what_counts_several_times_is_as_many_rows() -> None:
    field, terms, theta = draw((20,))
    last = terms[-1]
    assert last.target is not None
    twice = replace(last, points=last.points.repeat(2, 1), target=last.target.repeat(2))
    whole = LastLayer.of(field, [*terms[:2], twice], theta)
    # A term is a mean: its weight times the number of its points is that of each one.
    once = LastLayer.of(field, [replace(last, weight=2.0 * len(last))], theta)
    sum_ = LastLayer.of(field, terms[:2], theta).plus(once, 0.1 / (2 * len(last)))
    torch.testing.assert_close(sum_.product.tril(), whole.product.tril())
    torch.testing.assert_close(sum_.gradient, whole.gradient)
    torch.testing.assert_close(sum_.solved(1e-9), solve_last_layer(field, [*terms[:2], twice], theta, 1e-9))


def test_terms_without_points_have_no_equations() -> None:
    field, terms, theta = draw((20,))
    none = replace(terms[0], points=terms[0].points[:0])
    empty = LastLayer.of(field, [none], theta)
    assert empty.product.shape == (21, 21)
    whole = LastLayer.of(field, terms, theta)
    assert torch.equal(whole.plus(empty).product, whole.product)
    assert torch.equal(LastLayer.of(field, [*terms, none], theta).gradient, whole.gradient)


@pytest.mark.parametrize("term", range(3), ids=["values", "normals", "distances"])
def test_a_wide_layers_equations_are_those_of_its_rows(term: int, monkeypatch: pytest.MonkeyPatch) -> None:
    field, terms, theta = draw((20,))
    weights = torch.linspace(0.5, 2.0, len(terms[term]), dtype=torch.float64)
    chosen = [replace(terms[term], weight=weights)]
    found = LastLayer.of(field, chosen, theta)
    # In several chunks as in one.
    monkeypatch.setitem(initialisation._weighted.__kwdefaults__, "chunk_points", 7)
    chunks = LastLayer.of(field, chosen, theta)
    monkeypatch.setattr(initialisation, "_ONE_LAYER_SUMS", {})
    rows = LastLayer.of(field, chosen, theta)
    # Sines at coarse distances are rounded.
    near = {"rtol": 0.0, "atol": 1e-5 if term == 2 else 1e-12}
    for equations in (found, chunks):
        torch.testing.assert_close(equations.product.tril(), rows.product.tril(), **near)
        torch.testing.assert_close(equations.gradient, rows.gradient, **near)


def test_values_that_are_not_finite_end_with_a_sentence() -> None:
    field, terms, theta = draw((20,))
    broken = [*terms, ObjectiveTerm("distance", signed_distance, terms[0].points, terms[0].points[:, 0] * torch.nan)]
    with pytest.raises(FitError, match="not finite"):
        solve_last_layer(field, broken, theta)
