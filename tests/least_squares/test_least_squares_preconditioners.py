"""Preconditioners: exact where they should be, always definite, and better than none."""

from __future__ import annotations

import pytest
import torch
from damped_problems import F64, PROBLEMS, Problem, layered, multiplied_out, randn
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gnrecon.least_squares import (
    BlockJacobi,
    DenseJacobian,
    Jacobi,
    Jacobian,
    Kronecker,
    LayeredJacobian,
    LayerRows,
    NeighbourSums,
    Nystrom,
    Preconditioner,
    SampledGram,
    Sketch,
    conjugate_gradients,
    direct,
    preconditioners,
)
from gnrecon.least_squares.krylov import Apply, KrylovResult
from gnrecon.least_squares.neighbour_sums import PreparedSums, run_lengths
from gnrecon.least_squares.preconditioners import inclusion_probabilities

PRECONDITIONERS: dict[str, Preconditioner] = {
    "jacobi": Jacobi(),
    "block jacobi": BlockJacobi(),
    "neighbours": NeighbourSums(),
    "neighbours, similar or not": NeighbourSums(-2.0),
    "nystrom": Nystrom(5),
    "nystrom, full": Nystrom(1000),
    "sampled": SampledGram(15),
    "sampled, all": SampledGram(1000),
    "sketch": Sketch(2.0),
    "kronecker": Kronecker(),
    "kronecker, drawn": Kronecker(rows=15),
}
each = pytest.mark.parametrize("name", PRECONDITIONERS)


def at(preconditioner: Preconditioner, jacobian: DenseJacobian | LayeredJacobian, D: Tensor, damping: float) -> Apply:
    """Prepare and adapt in one."""
    return preconditioner.prepare(jacobian, D, torch.Generator().manual_seed(0)).at(damping)


def as_matrix(apply: Apply, size: int) -> Tensor:
    """Columns of the map."""
    return torch.stack([apply(column) for column in torch.eye(size, dtype=F64)], 1)


def metric_of(J: Tensor) -> Tensor:
    """A metric that differs from column to column."""
    return torch.linspace(0.5, 2.0, J.shape[1], dtype=F64)


@each
@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("damping", [0.0, 1e-8, 1.0])
def test_symmetric_definite_and_finite(name: str, problem: str, damping: float) -> None:
    made: Problem = PROBLEMS[problem](0, F64)
    if name.startswith("kronecker") and isinstance(made.jacobian, DenseJacobian):
        with pytest.raises(ValueError, match="layered"):
            at(Kronecker(), made.jacobian, metric_of(made.J), damping)
        return
    assert isinstance(made.jacobian, DenseJacobian | LayeredJacobian)
    P = as_matrix(at(PRECONDITIONERS[name], made.jacobian, metric_of(made.J), damping), made.J.shape[1])
    assert bool(torch.isfinite(P).all())
    values = torch.linalg.eigvalsh(0.5 * (P + P.T))
    assert float((P - P.T).norm()) <= 1e-6 * float(P.norm())
    assert float(values[0]) > -1e-10 * float(values[-1])
    assert bool((P.diagonal() > 0.0).all())


def smooth(seed: int, count: int) -> tuple[DenseJacobian, Tensor]:
    """Rows along a curve, as many columns: products of few waves, so that a row differs little from the next one."""
    generator = torch.Generator().manual_seed(seed)
    t = torch.linspace(0, 1, count, dtype=F64)[:, None]
    J = torch.cos(t * torch.arange(12) + randn(generator, 12)) @ randn(generator, 12, count)
    return DenseJacobian(J), J


def test_neighbours_that_are_alike_take_few_iterations() -> None:
    jacobian, J = smooth(0, 400)
    assert run_lengths(jacobian, 0.8) == [8]
    D = metric_of(J)
    b = J.T @ randn(torch.Generator().manual_seed(1), 400)
    for damping in (1e-4, 1.0):
        A = J.T @ J + damping * torch.diag(D)
        expected = torch.linalg.solve(A, b)

        def solved(
            preconditioner: Preconditioner, tolerance: float, energy: float, A: Tensor = A, damping: float = damping
        ) -> KrylovResult:
            P = at(preconditioner, jacobian, D, damping)
            return conjugate_gradients(lambda v: A @ v, b, P, tolerance, 200, energy)

        off = solved(NeighbourSums(), 0.0, 0.01).solution - expected
        assert float(off @ A @ off) < 4e-4 * float(expected @ A @ expected), "the error is measured as it is"
        assert solved(NeighbourSums(), 1e-6, 0.0).iterations < solved(Jacobi(), 1e-6, 0.0).iterations / 2


def test_runs_are_as_long_as_their_ends_are_alike() -> None:
    generator = torch.Generator().manual_seed(0)
    assert run_lengths(DenseJacobian(randn(generator, 400, 30)), 0.8) == [1]
    # Rows that turn by 0.1 each: 0.3 and 0.7 between the ends of 4 and 8 rows, whose cosines are 0.96 and 0.76.
    angle = 0.1 * torch.arange(400, dtype=F64)
    turning = torch.stack([angle.cos(), angle.sin()], 1)
    assert run_lengths(DenseJacobian(turning), 0.8) == [4]
    assert run_lengths(DenseJacobian(turning), 0.7) == [8]
    assert run_lengths(DenseJacobian(0.0 * turning), 0.8) == [1], "zero rows are similar to none"
    assert run_lengths(DenseJacobian(turning[:7]), 0.0) == [1], "a stretch shorter than the longest run"
    blocks = layered(0, [(7, 1), (40, 1), (0, 0)])[0]
    assert run_lengths(blocks, -2.0) == [1, 8, 1], "each block has its own runs"


def test_run_lengths_are_computed_again_after_some_linearisations() -> None:
    generator = torch.Generator().manual_seed(0)
    turning, unlike = smooth(0, 400)[0], DenseJacobian(randn(generator, 400, 400))
    neighbours = NeighbourSums()
    assert neighbours.refresh_interval == 8

    def summed(jacobian: Jacobian) -> bool:
        prepared = neighbours.prepare(jacobian, torch.ones(jacobian.columns, dtype=F64), generator)
        return isinstance(prepared, PreparedSums)

    assert summed(turning)
    # The run lengths of the first rows are used for some more linearisations, then computed again.
    assert [summed(unlike) for _ in range(8)] == [True] * 7 + [False]
    assert not summed(layered(0, [(40, 1), (40, 0)])[0]), "other constraints have runs of their own"


def test_neighbours_that_are_no_fewer_than_the_columns_give_the_inverse() -> None:
    J = randn(torch.Generator().manual_seed(2), 60, 20)
    D = metric_of(J)
    P = as_matrix(at(NeighbourSums(), DenseJacobian(J), D, 0.1), 20)
    torch.testing.assert_close(P, torch.linalg.inv(J.T @ J + 0.1 * torch.diag(D)))


@pytest.mark.parametrize("damping", [1e-3, 1.0])
@pytest.mark.parametrize(
    "preconditioner", [SampledGram(1000), Nystrom(1000), Sketch(10.0)], ids=lambda p: type(p).__name__
)
def test_all_rows_or_full_rank_give_the_inverse(preconditioner: Preconditioner, damping: float) -> None:
    jacobian, J = layered(1)
    D = metric_of(J)
    P = as_matrix(at(preconditioner, jacobian, D, damping), J.shape[1])
    A = J.T @ J + damping * torch.diag(D)
    torch.testing.assert_close(P @ A, torch.eye(len(A), dtype=F64), rtol=0.0, atol=1e-7)


def test_sampled_rows_that_are_stored_in_float32_are_multiplied_in_float64() -> None:
    jacobian, J = layered(1, [(6, True)], stored=torch.float32)
    P = as_matrix(at(SampledGram(1000), jacobian, torch.ones(J.shape[1], dtype=F64), 1e-10), J.shape[1])
    # Six rows leave a null space, in which P^-1 is 1 / damping; float32 products would put 1e-7 |J|^2 there.
    assert float(torch.linalg.eigvalsh(0.5 * (P + P.T))[-1]) == pytest.approx(1e10, rel=1e-2)


def test_rounded_rows_have_a_rounded_factor_where_the_damping_hides_that(monkeypatch: pytest.MonkeyPatch) -> None:
    # A singular matrix, to which single precision adds nothing below 1e-7.
    product, D = torch.ones(2, 2, dtype=F64), torch.ones(2, dtype=F64)
    r = torch.tensor([1.0, 0.5], dtype=F64)
    asked = []
    factor = preconditioners.damped_factor

    def counted(product: Tensor, diagonal: Tensor, overwrite: bool = False) -> Tensor | None:
        asked.append(product.dtype)
        return factor(product, diagonal, overwrite)

    for module in (direct, preconditioners):
        monkeypatch.setattr(module, "damped_factor", counted)
    prepared = preconditioners.PreparedGram(product, D, torch.float32)
    for damping, precisions in ((0.1, [torch.float32]), (1e-12, [torch.float32, torch.float64])):
        asked.clear()
        found = prepared.at(damping)(r)
        assert asked == precisions
        assert found.dtype == F64
        torch.testing.assert_close(product @ found + damping * found, r, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("preconditioner", [SampledGram(300), Sketch(15.0)], ids=lambda p: type(p).__name__)
def test_many_rows_are_near_all(preconditioner: Preconditioner) -> None:
    J = randn(torch.Generator().manual_seed(2), 4000, 20)
    P = as_matrix(at(preconditioner, DenseJacobian(J), torch.ones(20, dtype=F64), 0.0), 20)
    values = torch.linalg.eigvals(P @ J.T @ J).real
    # The extreme eigenvalues of the sample are about 1 -+ 2 sqrt(p / m), here 0.48 and 1.52; P has their inverses.
    assert 0.4 < float(values.min()) < float(values.max()) < 2.5
    assert abs(float(values.mean()) - 1.0) < 0.2, "the sum is scaled to the number of all rows"


def test_sampled_rows_come_from_all_blocks() -> None:
    # Only the second block sees the second column.
    J = torch.zeros(400, 2, dtype=F64)
    J[:200, 0], J[200:, 1] = 1.0, 1.0
    P = as_matrix(at(SampledGram(100), DenseJacobian(J), torch.ones(2, dtype=F64), 0.0), 2)
    torch.testing.assert_close(P.diagonal(), J.new_full((2,), 1 / 200), rtol=0.4, atol=0.0)


def test_a_sketch_keeps_the_one_row_that_matters() -> None:
    J = torch.zeros(4000, 3, dtype=F64)
    J[:, 0] = 1.0
    J[:, 1] = torch.linspace(-1, 1, 4000)
    J[1234, 2] = 5.0
    P = as_matrix(at(Sketch(20.0), DenseJacobian(J), torch.ones(3, dtype=F64), 0.0), 3)
    values = torch.linalg.eigvals(P @ J.T @ J).real
    assert 0.1 < float(values.min()) < float(values.max()) < 10.0


def test_block_jacobi_is_exact_where_groups_share_no_rows() -> None:
    generator = torch.Generator().manual_seed(3)
    J = torch.zeros(21, 10, dtype=F64)
    J[:9, :4], J[9:, 4:] = randn(generator, 9, 4), randn(generator, 12, 6)
    D = metric_of(J)
    P = as_matrix(at(BlockJacobi(), DenseJacobian(J, (4, 6)), D, 0.3), 10)
    torch.testing.assert_close(P, torch.linalg.inv(J.T @ J + 0.3 * torch.diag(D)))


def test_jacobi_is_exact_for_orthogonal_columns() -> None:
    J = torch.linalg.qr(randn(torch.Generator().manual_seed(4), 9, 4)).Q * torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=F64)
    D = metric_of(J)
    P = as_matrix(at(Jacobi(), DenseJacobian(J), D, 0.3), 4)
    torch.testing.assert_close(P, torch.linalg.inv(J.T @ J + 0.3 * torch.diag(D)))


@pytest.mark.parametrize("tangents", [False, True])
@pytest.mark.parametrize("damping", [1e-2, 10.0])
def test_kronecker_is_exact_for_a_kronecker_product(tangents: bool, damping: float) -> None:
    # Every left vector with every input: sum_jk (l_j l_j^T) (x) (i_k, 1)(i_k, 1)^T is one Kronecker product.
    generator = torch.Generator().manual_seed(5)
    outs, ins = randn(generator, 6, 3), randn(generator, 8, 4)
    left, inputs = outs.repeat_interleave(8, 0), ins.repeat(6, 1)
    # With r = l the matrix is l (i + t, 1)^T, again the product of the two.
    layer = LayerRows(left, inputs - 1.0, left, torch.ones_like(inputs)) if tangents else LayerRows(left, inputs)
    other = LayerRows(torch.zeros(48, 2, dtype=F64), torch.zeros(48, 3, dtype=F64))
    jacobian = LayeredJacobian(lambda: [[layer, other]], 48, (15, 8), torch.device("cpu"))
    J = torch.cat([multiplied_out(layer), multiplied_out(other)], 1)
    D = torch.cat([J.new_full((15,), 2.0), J.new_full((8,), 0.5)])
    P = as_matrix(at(Kronecker(), jacobian, D, damping), 23)
    torch.testing.assert_close(P, torch.linalg.inv(J.T @ J + damping * torch.diag(D)), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_kronecker_factors_of_drawn_rows_are_near_those_of_all(seed: int) -> None:
    jacobian, J = layered(seed, [(3000, True), (3000, False)], (3, 2))
    D = torch.ones(J.shape[1], dtype=F64)
    from_all = as_matrix(at(Kronecker(), jacobian, D, 1.0), J.shape[1])
    from_few = as_matrix(at(Kronecker(rows=2000), jacobian, D, 1.0), J.shape[1])
    assert not torch.equal(from_few, from_all)
    # Of 2,000 rows, a sum of squares is known to about sqrt(2 / 2000) = 3 %, unless a scale is missing.
    assert float((from_few @ torch.linalg.inv(from_all) - torch.eye(len(D), dtype=F64)).norm(2)) < 0.25


def test_kronecker_factors_are_the_nearest_ones() -> None:
    jacobian, J = layered(6, [(20, True), (30, False)], (3, 2))
    P = as_matrix(at(Kronecker(turns=60), jacobian, torch.ones(8, dtype=F64), 1e-9), 8)
    # G with its indices in Van Loan's and Pitsianis' order has the nearest product as its leading singular pair.
    order = torch.tensor([0, 1, 2, 6, 3, 4, 5, 7])
    G = (J.T @ J)[order][:, order]
    turned = G.view(2, 4, 2, 4).permute(0, 2, 1, 3).reshape(4, 16)
    U, S, Vh = torch.linalg.svd(turned)
    nearest = S[0] * torch.kron(U[:, 0].view(2, 2), Vh[0].view(4, 4))
    torch.testing.assert_close(torch.linalg.inv(P)[order][:, order], nearest, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("units", [((), None), (None, ()), ((1, 2), (0,))])
def test_layers_with_fixed_units(units: tuple[tuple[int, ...] | None, ...]) -> None:
    jacobian, J = layered(7, units=units)
    for preconditioner in PRECONDITIONERS.values():
        r = randn(torch.Generator().manual_seed(0), J.shape[1])
        z = at(preconditioner, jacobian, metric_of(J), 1e-2)(r)
        assert z.shape == r.shape
        assert float(r @ z) > 0.0


@pytest.mark.parametrize(
    "preconditioner",
    [Jacobi(), BlockJacobi(), Nystrom(30), SampledGram(200), Sketch(4.0), Kronecker()],
    ids=lambda p: type(p).__name__,
)
def test_fewer_iterations_than_without(preconditioner: Preconditioner) -> None:
    jacobian, J = layered(8, [(300, True), (300, False)], (3, 8, 6, 1))
    # The layers' rows differ by factors of ten already; the inputs of each differ as well.
    scale = torch.tensor([1.0, 0.1, 0.03], dtype=F64)
    blocks = [[LayerRows(b[0].left, b[0].inputs * scale, b[0].right, b[0].tangents), *b[1:]] for b in jacobian.blocks()]
    for block in blocks:
        if block[0].tangents is not None:
            block[0].tangents.mul_(scale)
    jacobian = LayeredJacobian(lambda: blocks, jacobian.rows, jacobian.group_sizes, jacobian.device)
    D = torch.ones(J.shape[1], dtype=F64)
    b = randn(torch.Generator().manual_seed(9), J.shape[1])

    def product(v: Tensor) -> Tensor:
        return jacobian.tmv(jacobian.mv(v)) + 1e-4 * v

    plain = conjugate_gradients(product, b, torch.clone, 1e-8, 1000)
    helped = conjugate_gradients(product, b, at(preconditioner, jacobian, D, 1e-4), 1e-8, 1000)
    assert plain.converged
    assert helped.converged
    assert helped.iterations < 0.7 * plain.iterations


@given(seed=st.integers(0, 2**31), count=st.integers(1, 49))
@settings(max_examples=30, deadline=None)
def test_chances_by_length_sum_to_the_count(seed: int, count: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    squares = torch.rand(50, generator=generator, dtype=F64) ** 8
    chances = inclusion_probabilities(squares, count)
    assert float(chances.sum()) == pytest.approx(count, rel=1e-9)
    assert float(chances.min()) >= 0.0
    assert float(chances.max()) <= 1.0
    unsure = chances < 1.0
    ratio = chances[unsure] / squares[unsure]
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), rtol=1e-9, atol=0.0)
    assert not bool(unsure.all()) or float(squares.max() * ratio[0]) <= 1.0 + 1e-9


def test_chances_of_rows_without_length() -> None:
    assert torch.equal(inclusion_probabilities(torch.zeros(8, dtype=F64), 2), torch.full((8,), 0.25, dtype=F64))
    alone = torch.tensor([0.0, 3.0, 0.0, 0.0], dtype=F64)
    assert torch.equal(inclusion_probabilities(alone, 2), torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=F64))


def test_few_heavy_rows_are_all_drawn() -> None:
    """With equal chances they would be missed, and conjugate gradients would have to find them one by one."""
    generator = torch.Generator().manual_seed(2)
    J = torch.randn(2000, 40, generator=generator, dtype=F64)
    J[torch.randperm(2000, generator=generator)[:30]] *= 1e3
    jacobian = DenseJacobian(J)
    P = SampledGram(200).prepare(jacobian, torch.ones(40, dtype=F64), generator).at(1e-3)
    result = conjugate_gradients(lambda v: J.T @ (J @ v) + 1e-3 * v, torch.ones(40, dtype=F64), P, 1e-8, 100)
    assert result.converged
    assert result.iterations <= 25
