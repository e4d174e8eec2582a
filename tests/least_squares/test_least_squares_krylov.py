"""Krylov methods against dense solves."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from damped_problems import F64, randn
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gnrecon.least_squares import KrylovResult, conjugate_gradients, gmres
from gnrecon.least_squares.krylov import Apply

Method = Callable[[Apply, Tensor, Apply, float, int], KrylovResult]
METHODS: list[Method] = [conjugate_gradients, gmres]
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__name__)
few = settings(max_examples=8, deadline=None)
seeds = given(seed=st.integers(0, 2**31))


def definite(seed: int, size: int = 15, decades: float = 3.0) -> tuple[Tensor, Tensor]:
    """A definite matrix with eigenvalues from 1 to 10^decades, and a right-hand side."""
    generator = torch.Generator().manual_seed(seed)
    Q = torch.linalg.qr(randn(generator, size, size)).Q
    return Q * torch.logspace(0, decades, size, dtype=F64) @ Q.T, randn(generator, size)


def plain(r: Tensor) -> Tensor:
    """No preconditioner."""
    return r.clone()


def diagonal(A: Tensor) -> Apply:
    """The diagonal as the preconditioner."""
    return lambda r: r / A.diagonal()


@each_method
@pytest.mark.parametrize("preconditioned", [False, True])
@few
@seeds
def test_solution(method: Method, preconditioned: bool, seed: int) -> None:
    A, b = definite(seed)
    result = method(A.mv, b, diagonal(A) if preconditioned else plain, 1e-10, 100)
    assert result.converged
    assert result.failure is None
    assert 1 <= result.iterations <= 45
    # |error| <= |A^-1| |rest| and the least eigenvalue is 1
    torch.testing.assert_close(result.solution, torch.linalg.solve(A, b), rtol=0.0, atol=2e-10 * float(b.norm()))
    torch.testing.assert_close(result.rest, b - A @ result.solution, rtol=0.0, atol=1e-11 * float(b.norm()))
    assert float(result.rest.norm()) <= 1e-10 * float(b.norm())


@each_method
def test_an_exact_preconditioner_needs_one_iteration(method: Method) -> None:
    A, b = definite(1)
    result = method(A.mv, b, lambda r: torch.linalg.solve(A, r), 1e-8, 100)
    assert result.converged
    assert result.iterations == 1


@each_method
@few
@seeds
def test_every_iteration_brings_the_solution_nearer(method: Method, seed: int) -> None:
    A, b = definite(seed)
    value = 0.0
    for limit in range(1, 12):
        result = method(A.mv, b, diagonal(A), 1e-12, limit)
        assert result.iterations == limit
        assert not result.converged
        assert result.failure is None
        x = result.solution
        torch.testing.assert_close(result.rest, b - A @ x, rtol=0.0, atol=1e-10 * float(b.norm()))
        lower = float(0.5 * x @ A @ x - b @ x)
        if method is not gmres:
            assert lower < value, "a truncated iterate is a better descent step than the one before"
        value = lower


@few
@seeds
def test_a_solve_goes_on_where_another_has_ended(seed: int) -> None:
    A, b = definite(seed)
    begun = conjugate_gradients(A.mv, b, plain, 1e-12, 6)
    assert not begun.converged
    better: Apply = lambda r: torch.linalg.solve(A + 0.1 * torch.diag(A.diagonal()), r)  # noqa: E731
    kept = begun.solution.clone(), begun.rest.clone()
    whole = conjugate_gradients(A.mv, b, better, 1e-10, 100, energy=1e-3)
    rest = conjugate_gradients(A.mv, b, better, 1e-10, 100, energy=1e-3, start=begun)
    assert whole.converged
    assert rest.converged
    assert rest.iterations <= whole.iterations + 3
    assert torch.equal(begun.solution, kept[0])
    assert torch.equal(begun.rest, kept[1])
    # Both end at the same share of the error of x = 0, as the preconditioner measures it, however near the start is.
    for result in (whole, rest):
        r = result.rest
        assert float(r @ better(r)) <= 1e-6 * float(b @ better(b))
        torch.testing.assert_close(result.rest, b - A @ result.solution, rtol=0.0, atol=1e-10 * float(b.norm()))
    again = conjugate_gradients(A.mv, b, better, 1e-10, 100, energy=2e-3, start=rest)
    assert (again.iterations, again.converged) == (0, True)
    assert torch.equal(again.solution, rest.solution)


def test_each_method_minimises_its_own_norm() -> None:
    A, b = definite(2)
    exact = torch.linalg.solve(A, b)
    results = [method(A.mv, b, plain, 1e-14, 5) for method in METHODS]
    errors = [float((r.solution - exact) @ A @ (r.solution - exact)) for r in results]
    rests = [float(r.rest.norm()) for r in results]
    assert errors[0] < errors[1]
    assert rests[1] < rests[0]


@each_method
def test_zero_right_hand_side(method: Method) -> None:
    A, b = definite(3)
    result = method(A.mv, torch.zeros_like(b), plain, 1e-6, 100)
    assert result.converged
    assert result.iterations == 0
    assert not bool(result.solution.any())


@each_method
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_right_hand_side_that_is_not_finite(method: Method, bad: float) -> None:
    A, b = definite(4)
    b[2] = bad
    result = method(A.mv, b, plain, 1e-6, 100)
    assert not result.converged
    assert result.failure
    assert not bool(result.solution.any())


@each_method
def test_a_product_that_is_not_finite_leaves_the_last_iterate(method: Method) -> None:
    A, b = definite(5)
    calls: list[int] = []

    def breaking(v: Tensor) -> Tensor:
        calls.append(1)
        return A @ v if len(calls) < 4 else torch.full_like(v, torch.nan)

    result = method(breaking, b, plain, 1e-10, 100)
    before = method(A.mv, b, plain, 1e-10, 3)
    assert len(calls) == 4
    assert not result.converged
    assert "finite" in (result.failure or "")
    torch.testing.assert_close(result.solution, before.solution)
    torch.testing.assert_close(result.rest, before.rest)


def test_indefinite_matrices() -> None:
    A, b = definite(6)
    Q, values = torch.linalg.eigh(A).eigenvectors, torch.linalg.eigh(A).eigenvalues
    values[:4] *= -1.0
    A = Q * values @ Q.T
    broken = conjugate_gradients(A.mv, b, plain, 1e-10, 100)
    assert not broken.converged
    assert "definite" in (broken.failure or "")
    assert bool(torch.isfinite(broken.solution).all())
    torch.testing.assert_close(broken.rest, b - A @ broken.solution)
    result = gmres(A.mv, b, plain, 1e-10, 200)
    assert result.converged
    torch.testing.assert_close(result.solution, torch.linalg.solve(A, b))
    assert conjugate_gradients((-A @ A).mv, b, plain, 1e-10, 100).iterations == 1


def test_indefinite_preconditioners() -> None:
    A, b = definite(7)
    result = conjugate_gradients(A.mv, b, lambda r: -r, 1e-6, 100)
    assert result.iterations == 0
    assert "preconditioner" in (result.failure or "")


@each_method
def test_singular_matrices(method: Method) -> None:
    A, b = definite(8)
    values, Q = torch.linalg.eigh(A)
    values[:5] = 0.0
    A = Q * values @ Q.T
    solvable = method(A.mv, A @ b, plain, 1e-8, 100)
    assert solvable.converged
    torch.testing.assert_close(A @ solvable.solution, A @ b, rtol=0.0, atol=1e-7 * float((A @ b).norm()))
    without = method(A.mv, b, plain, 1e-8, 100)
    assert not without.converged
    assert bool(torch.isfinite(without.solution).all())


@few
@seeds
def test_gmres_solves_unsymmetric_systems_and_restarts(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    A = 10.0 * torch.eye(80, dtype=F64) + randn(generator, 80, 80) / 1.5
    b = randn(generator, 80)
    result = gmres(A.mv, b, lambda r: r / (1.0 + torch.arange(80, dtype=F64) / 8), 1e-12, 400)
    assert result.converged
    torch.testing.assert_close(result.solution, torch.linalg.solve(A, b), rtol=1e-8, atol=1e-10)


def test_gmres_restarts_after_its_basis_is_full() -> None:
    A, b = definite(9, size=120, decades=4.0)
    result = gmres(A.mv, b, plain, 1e-4, 2000)
    assert result.converged
    assert result.iterations > 50, "more than the basis"
    torch.testing.assert_close(result.rest, b - A @ result.solution, rtol=0.0, atol=1e-9)
