"""Every solver on every problem against the dense least-squares solution, and what they say when there is none."""

from __future__ import annotations

import math

import pytest
import torch
from damped_problems import F64, PROBLEMS, Problem, layered, randn
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gnrecon.least_squares import (
    SOLVERS,
    Averaged,
    DenseJacobian,
    Jacobian,
    LayeredJacobian,
    Metric,
    Step,
    identity,
    jacobian_layer_scaled,
    jacobian_scaled,
    layer_scaled,
)

METRICS = [identity, layer_scaled, jacobian_scaled, jacobian_layer_scaled]
each_solver = pytest.mark.parametrize("solver", SOLVERS)
each_metric = pytest.mark.parametrize("metric", METRICS, ids=lambda metric: metric.__name__)
each_storage = pytest.mark.parametrize("stored", [torch.float64, torch.float32], ids=["f64", "f32"])
few = settings(max_examples=4, deadline=None)
seeds = given(seed=st.integers(0, 2**31))


def suits(solver: str, jacobian: Jacobian, metric: Metric) -> bool:
    """Whether a solver is meant for such a system."""
    if solver == "cg-kronecker":
        return isinstance(jacobian, LayeredJacobian)
    return not (solver == "row-space" and metric in (jacobian_scaled, jacobian_layer_scaled))


def oracle(J: Tensor, r: Tensor, D: Tensor, damping: float) -> Tensor:
    """Minimise |r + J s|^2 + damping |s|_D^2 as one plain least-squares problem."""
    stacked = torch.cat([J, torch.diag((damping * D).sqrt())])
    right = torch.cat([-r, r.new_zeros(J.shape[1])])
    solution: Tensor = torch.linalg.lstsq(stacked, right[:, None], driver="gelsd").solution
    return solution[:, 0]


def check(problem: Problem, step: Step, D: Tensor, damping: float, stored: torch.dtype) -> None:
    """Compare a step with the oracle, to within what the tolerance of the solve and rounding explain.

    (J^T J + damping D) s = -g is left with at most 1e-6 |g|, or with rounding: products with J and sums of M terms lose
    about eps |J| |r| in g and eps |A| |s| in A s. In row space the condition of K = J D^-1 J^T enters as well.
    """
    assert step.failure is None
    A = problem.J.T @ problem.J + damping * torch.diag(D)
    g, s = problem.J.T @ problem.r, oracle(problem.J, problem.r, D, damping)
    values = torch.linalg.eigvalsh(A)
    least, largest = float(values[0]), float(values[-1])
    size = float(problem.J.norm() * problem.r.norm())
    eps = torch.finfo(stored).eps
    rounding = 20.0 * eps * (size + largest * float(s.norm()))
    off = float((A @ step.direction.double() + g).norm())
    assert off <= 2e-6 * float(g.norm()) + rounding * math.sqrt(largest / least)
    assert float((step.direction.double() - s).norm()) <= (2e-6 * float(g.norm()) + rounding * largest / least) / least
    linear = problem.r + problem.J @ step.direction.double()
    decrease = float(problem.r @ problem.r - linear @ linear) / 2
    assert step.predicted == pytest.approx(decrease, rel=1e-5, abs=50.0 * eps * float(problem.r @ problem.r))


@each_solver
@pytest.mark.parametrize("name", PROBLEMS)
@each_storage
@each_metric
@few
@seeds
def test_step_is_the_least_squares_solution(
    solver: str, name: str, stored: torch.dtype, metric: Metric, seed: int
) -> None:
    problem = PROBLEMS[name](seed, stored)
    if not suits(solver, problem.jacobian, metric):
        return
    D = metric(problem.jacobian)
    damping = 1e-2 * float(problem.jacobian.diagonal().mean() / D.mean())
    system = SOLVERS[solver]().linearise(problem.jacobian, problem.r, metric)
    assert system.loss == pytest.approx(0.5 * float(problem.r @ problem.r), rel=1e-6)
    atol = 1e2 * torch.finfo(stored).eps * float(problem.J.norm() * problem.r.norm())
    torch.testing.assert_close(system.equations.gradient.double(), problem.J.T @ problem.r, rtol=0.0, atol=atol)
    check(problem, system.solve(damping), D.double(), damping, stored)


@each_solver
@pytest.mark.parametrize("name", ["network", "wide_network"])
def test_one_system_serves_many_dampings(solver: str, name: str) -> None:
    problem = PROBLEMS[name](7, F64)
    D = layer_scaled(problem.jacobian)
    system = SOLVERS[solver]().linearise(problem.jacobian, problem.r, layer_scaled)
    steps = {damping: system.solve(damping) for damping in (1e-1, 1e-4, 10.0, 1e-3)}
    for damping, step in steps.items():
        check(problem, step, D, damping, F64)
    assert steps[1e-4].predicted > steps[1e-3].predicted > steps[1e-1].predicted > steps[10.0].predicted > 0.0
    again = system.solve(1e-1)
    assert torch.equal(again.direction, steps[1e-1].direction)


@each_solver
@pytest.mark.parametrize("name", ["tall", "network", "wide_network"])
@few
@seeds
def test_one_system_serves_other_residuals(solver: str, name: str, seed: int) -> None:
    problem = PROBLEMS[name](seed, F64)
    if not suits(solver, problem.jacobian, layer_scaled):
        return
    D = layer_scaled(problem.jacobian)
    system = SOLVERS[solver]().linearise(problem.jacobian, problem.r, layer_scaled)
    first = system.solve(1e-2)
    other = Problem(problem.jacobian, problem.J, randn(torch.Generator().manual_seed(seed + 1), len(problem.r)))
    for damping in (1e-2, 1e-1):
        check(other, system.solve(damping, other.r), D, damping, F64)
    assert torch.equal(system.solve(1e-2).direction, first.direction)
    assert system.solve(1e-2, torch.full_like(other.r, math.nan)).failure


@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "row-space"])
@pytest.mark.parametrize("name", ["tall", "network"])
def test_without_damping(solver: str, name: str) -> None:
    problem = PROBLEMS[name](8, F64)
    if suits(solver, problem.jacobian, identity):
        step = SOLVERS[solver]().linearise(problem.jacobian, problem.r, identity).solve(0.0)
        check(problem, step, torch.ones(problem.J.shape[1], dtype=F64), 0.0, F64)


@pytest.mark.parametrize("solver", ["row-space", "auto"])
def test_without_damping_fewer_rows_than_columns_are_satisfied(solver: str) -> None:
    problem = PROBLEMS["wide"](9, F64)
    step = SOLVERS[solver]().linearise(problem.jacobian, problem.r, identity).solve(0.0)
    torch.testing.assert_close(step.direction, -torch.linalg.pinv(problem.J) @ problem.r)
    assert step.predicted == pytest.approx(0.5 * float(problem.r @ problem.r))


@each_solver
@pytest.mark.parametrize("name", ["duplicates", "zero_column", "wide"])
def test_singular_without_damping(solver: str, name: str) -> None:
    problem = PROBLEMS[name](10, F64)
    if not suits(solver, problem.jacobian, identity):
        return
    step = SOLVERS[solver]().linearise(problem.jacobian, problem.r, identity).solve(0.0)
    if solver in ("cholesky", "qr") or (solver == "row-space" and name != "wide"):
        # Rounding may leave a matrix that passes for definite.
        assert step.failure or math.isfinite(step.predicted)
    if step.failure:
        assert step.failure.endswith(".")
        assert not bool(step.direction.any())
        assert step.predicted == 0.0
    elif solver not in ("cholesky", "qr", "row-space", "auto"):
        # J^T J s = -g has solutions nonetheless, and iterations find one.
        g = problem.J.T @ problem.r
        assert float((problem.J.T @ (problem.J @ step.direction) + g).norm()) <= 1e-4 * float(g.norm())


@pytest.mark.parametrize("solver", ["cholesky", "qr"])
def test_a_zero_column_without_damping_is_a_failure(solver: str) -> None:
    problem = PROBLEMS["zero_column"](11, F64)
    assert SOLVERS[solver]().linearise(problem.jacobian, problem.r, identity).solve(0.0).failure


def empty_jacobians() -> list[Jacobian]:
    """No rows, no columns, and neither."""
    return [
        DenseJacobian(torch.zeros(0, 4, dtype=F64)),
        DenseJacobian(torch.zeros(5, 0, dtype=F64)),
        layered(0, [(0, True)])[0],
        layered(0, units=((), ()))[0],
    ]


@each_solver
@each_metric
def test_nothing_to_solve(solver: str, metric: Metric) -> None:
    for jacobian in empty_jacobians():
        if suits(solver, jacobian, metric):
            system = SOLVERS[solver]().linearise(jacobian, torch.ones(jacobian.rows, dtype=F64), metric)
            step = system.solve(1e-3)
            assert step.failure
            assert step.direction.shape == (jacobian.columns,)


@each_solver
@each_metric
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["J", "r"])
def test_numbers_that_are_not_finite(solver: str, metric: Metric, bad: float, where: str) -> None:
    jacobian, J = layered(12)
    r = randn(torch.Generator().manual_seed(0), len(J))
    if where == "r":
        r[3] = bad
    else:
        next(iter(jacobian.blocks()))[0].inputs[2, 1] = bad
    plain = DenseJacobian(J.clone())
    plain.matrix[2, 1] = bad if where == "J" else 0.0
    for made in (jacobian, plain):
        if suits(solver, made, metric):
            step = SOLVERS[solver]().linearise(made, r, metric).solve(1e-3)
            assert step.failure == "The Jacobian or the residuals are not finite."
            assert not bool(step.direction.any())


@each_solver
@pytest.mark.parametrize("damping", [-1e-3, -1e6, math.nan])
def test_bad_dampings(solver: str, damping: float) -> None:
    problem = PROBLEMS["network"](13, F64)
    system = SOLVERS[solver]().linearise(problem.jacobian, problem.r, identity)
    assert "damping" in (system.solve(damping).failure or "")
    assert system.solve(1e-3).failure is None


@each_solver
def test_an_infinite_damping_gives_no_step(solver: str) -> None:
    problem = PROBLEMS["network"](14, F64)
    step = SOLVERS[solver]().linearise(problem.jacobian, problem.r, identity).solve(math.inf)
    assert step.failure or not bool(step.direction.any())


@each_solver
def test_residuals_must_match_the_rows(solver: str) -> None:
    problem = PROBLEMS["network"](15, F64)
    for wrong in (problem.r[:-1], problem.r[:, None]):
        with pytest.raises(ValueError, match="rows"):
            SOLVERS[solver]().linearise(problem.jacobian, wrong, identity)


def test_row_space_needs_a_metric_that_is_constant_on_groups() -> None:
    problem = PROBLEMS["network"](16, F64)
    with pytest.raises(ValueError, match="constant"):
        SOLVERS["row-space"]().linearise(problem.jacobian, problem.r, jacobian_scaled)


@each_solver
@few
@seeds
def test_marquardts_damping_does_not_depend_on_the_parameters_scales(solver: str, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    J, r = randn(generator, 30, 8), randn(generator, 30)
    scales = 10 ** torch.linspace(-2, 1, 8, dtype=F64)
    if suits(solver, DenseJacobian(J), jacobian_scaled):
        plain = SOLVERS[solver]().linearise(DenseJacobian(J), r, jacobian_scaled).solve(0.1)
        scaled = SOLVERS[solver]().linearise(DenseJacobian(J * scales), r, jacobian_scaled).solve(0.1)
        # The iterations' tolerance is in the norm of g, which does depend on the scales.
        torch.testing.assert_close(scaled.direction * scales, plain.direction, rtol=1e-3, atol=1e-3)
        assert scaled.predicted == pytest.approx(plain.predicted, rel=1e-3)


@each_solver
def test_descriptions_are_sentences(solver: str) -> None:
    made = SOLVERS[solver]()
    problem = PROBLEMS["network"](17, F64)
    before = made.describe()
    made.linearise(problem.jacobian, problem.r, identity)
    for sentence in (before, made.describe()):
        assert sentence.endswith(".")
        assert sentence[0].isupper()


def test_the_averaged_matrix_is_the_mean_of_the_steps() -> None:
    matrices = [torch.randn(9, 4, generator=torch.Generator().manual_seed(k), dtype=torch.float64) for k in range(4)]
    residual = torch.arange(9.0, dtype=torch.float64)
    solver = Averaged(keep=0.6)
    means = [solver.linearise(DenseJacobian(J), residual, identity).product.tril() for J in matrices]
    grams = [(J.T @ J).tril() for J in matrices]
    torch.testing.assert_close(means[1], (grams[0] + grams[1]) / 2)
    # The third counts two fifths, no longer a third.
    torch.testing.assert_close(means[2], 0.6 * means[1] + 0.4 * grams[2])
    step = solver.linearise(DenseJacobian(matrices[3]), residual, identity).solve(0.1).direction
    mean = 0.6 * means[3] + 0.4 * grams[3]
    damped = mean + mean.tril(-1).T + 0.1 * torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(damped @ step, -(matrices[3].T @ residual))
    other = DenseJacobian(torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(solver.linearise(other, residual[:3], identity).product, torch.eye(3).double())
