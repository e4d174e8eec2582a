"""Jacobians as operators against their dense matrices."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest
import torch
from damped_problems import F64, layer_rows, layered, multiplied_out, randn
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gnrecon.least_squares import DenseJacobian, Jacobian, LayeredJacobian, LayerRows
from gnrecon.least_squares import layered_jacobian as module
from gnrecon.least_squares.layer_products import gram
from gnrecon.runtime.parallel import fixed_sums

Made = tuple[Jacobian, Tensor]


def dense_with_groups(seed: int, stored: torch.dtype) -> Made:
    """A matrix whose columns are in three groups, one of them empty."""
    J = randn(torch.Generator().manual_seed(seed), 23, 12).to(stored)
    return DenseJacobian(J, (5, 0, 7), chunk=6), J.double()


def in_shares(seed: int, stored: torch.dtype) -> Made:
    """Blocks that are kept, so that J^T J is summed in two shares."""
    jacobian, J = layered(seed, [(4, True), (0, False), (7, True)], stored=stored)
    return replace(jacobian, kept=True), J


MAKERS: dict[str, Callable[[int, torch.dtype], Made]] = {
    "dense": dense_with_groups,
    "network": lambda seed, stored: layered(seed, stored=stored),
    "deep": lambda seed, stored: layered(seed, widths=(2, 5, 3, 4, 1), stored=stored),
    "one row": lambda seed, stored: layered(seed, [(1, True)], stored=stored),
    "an empty block": lambda seed, stored: layered(seed, [(0, True), (5, True), (0, False)], stored=stored),
    "no rows": lambda seed, stored: layered(seed, [(0, True)], stored=stored),
    "some units": lambda seed, stored: layered(seed, units=((2, 0), None), stored=stored),
    "a fixed layer": lambda seed, stored: layered(seed, units=((), None), stored=stored),
    "in shares": in_shares,
    "no columns": lambda seed, stored: layered(seed, units=((), ()), stored=stored),
    "dense, no rows": lambda _, stored: (DenseJacobian(torch.zeros(0, 4, dtype=stored)), torch.zeros(0, 4, dtype=F64)),
    "dense, no columns": lambda _, stored: (
        DenseJacobian(torch.zeros(4, 0, dtype=stored)),
        torch.zeros(4, 0, dtype=F64),
    ),
}
each_maker = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
each_storage = pytest.mark.parametrize("stored", [torch.float64, torch.float32])
few = settings(max_examples=5, deadline=None)
seeds = given(seed=st.integers(0, 2**31))


def close(actual: Tensor, expected: Tensor, stored: torch.dtype) -> None:
    """Agree to rounding in the storage's precision; sums here have at most a hundred terms of order 1 to 10."""
    loose = stored == torch.float32
    assert actual.shape == expected.shape
    torch.testing.assert_close(actual.double(), expected, rtol=1e-5 if loose else 1e-12, atol=1e-4 if loose else 1e-11)


@each_maker
@each_storage
@few
@seeds
def test_products(make: Callable[[int, torch.dtype], Made], stored: torch.dtype, seed: int) -> None:
    jacobian, J = make(seed, stored)
    generator = torch.Generator().manual_seed(seed + 1)
    v, u = randn(generator, J.shape[1]).to(jacobian.dtype), randn(generator, len(J)).to(jacobian.dtype)
    assert (jacobian.rows, jacobian.columns) == J.shape
    assert jacobian.mv(v).dtype == jacobian.tmv(u).dtype == jacobian.dtype
    close(jacobian.mv(v), J @ v.double(), stored)
    close(jacobian.tmv(u), J.T @ u.double(), stored)


@each_maker
@each_storage
@few
@seeds
def test_matrices(make: Callable[[int, torch.dtype], Made], stored: torch.dtype, seed: int) -> None:
    jacobian, J = make(seed, stored)
    rows = [chunk.clone() for chunk in jacobian.dense()]
    close(torch.cat(rows) if rows else J, J, stored)
    close(jacobian.gram().tril(), (J.T @ J).tril(), stored)
    close(jacobian.diagonal(), J.square().sum(0), stored)
    close(jacobian.row_squares(), J.square().sum(1), stored)
    assert sum(jacobian.constraint_rows) == len(J)


@each_maker
@each_storage
@pytest.mark.parametrize("length", [1, 2, 3, 100])
def test_runs(make: Callable[[int, torch.dtype], Made], stored: torch.dtype, length: int) -> None:
    jacobian, J = make(0, stored)
    sums = [
        part.sum(0) / math.sqrt(len(part))
        for stretch in J.split(list(jacobian.constraint_rows))
        for part in stretch.split(length)
        if len(part)
    ]
    found = list(jacobian.run_sums([length] * len(jacobian.constraint_rows)))
    assert all(chunk.dtype == stored for chunk in found)
    close(torch.cat([J[:0].to(stored), *found]), torch.stack(sums) if sums else J[:0], stored)
    close(jacobian.kernel().tril(), (J @ J.T).tril(), stored)
    assert [group.stop - group.start for group in jacobian.groups] == [len(part) for part in jacobian.group_grams()]
    for group, part in zip(jacobian.groups, jacobian.group_grams(), strict=True):
        close(part.tril(), (J[:, group].T @ J[:, group]).tril(), stored)


@each_maker
@each_storage
@few
@seeds
def test_scaled_kernel_and_sample(make: Callable[[int, torch.dtype], Made], stored: torch.dtype, seed: int) -> None:
    jacobian, J = make(seed, stored)
    scales = [10.0 ** (k - 1) for k in range(len(jacobian.groups))]
    S = torch.cat([torch.full((g.stop - g.start,), s, dtype=F64) for g, s in zip(jacobian.groups, scales, strict=True)])
    close(jacobian.kernel(scales).tril(), (J * S @ J.T).tril(), stored)
    generator = torch.Generator().manual_seed(seed)
    some = torch.randperm(len(J), generator=generator)[: len(J) // 2].sort().values
    sampled = jacobian.sample(some)
    assert (sampled.rows, sampled.columns) == (len(some), J.shape[1])
    close(sampled.gram().tril(), (J[some].T @ J[some]).tril(), stored)
    close(sampled.mv(torch.ones(J.shape[1], dtype=jacobian.dtype)), J[some].sum(1), stored)


@pytest.mark.parametrize("stored", [F64, torch.float32])
def test_products_of_kept_blocks_are_the_same_for_any_number_of_threads(stored: torch.dtype) -> None:
    jacobian, matrix = layered(3, rows=[(400, 0), (300, 1), (1, 1), (250, 4)], widths=(3, 16, 16, 1), stored=stored)
    jacobian = replace(jacobian, kept=True)
    generator = torch.Generator().manual_seed(0)
    v, u = randn(generator, jacobian.columns), randn(generator, jacobian.rows)
    found = []
    for threads in (1, 2, 3):
        with fixed_sums(threads):
            found.append((jacobian.mv(v), jacobian.tmv(u), jacobian.diagonal(), jacobian.row_squares()))
    for others in found[1:]:
        assert all(map(torch.equal, found[0], others))
    wanted = matrix @ v, matrix.T @ u, matrix.square().sum(0), matrix.square().sum(1)
    for product, right in zip(found[0], wanted, strict=True):
        torch.testing.assert_close(
            product, right, rtol=1e-3, atol=float(torch.finfo(stored).eps * 20 * right.abs().max())
        )


def test_rounded_factors_keep_the_precision_of_vectors() -> None:
    jacobian, J = layered(0)
    rounded = jacobian.rounded()
    assert all(layer.left.dtype == torch.float32 for block in rounded.blocks() for layer in block)
    v = torch.ones(J.shape[1], dtype=F64)
    assert rounded.mv(v).dtype == F64
    close(rounded.mv(v), J @ v, torch.float32)
    assert not torch.equal(rounded.mv(v), jacobian.mv(v))
    assert rounded.rounded() is rounded
    matrix = DenseJacobian(J)
    assert matrix.rounded() is matrix, "its vectors would be rounded with it"


def test_long_blocks_are_cut_into_tiles_and_chunks() -> None:
    jacobian, J = layered(3, [(70, True), (67, False)])
    jacobian = replace(jacobian, tile_rows=5, chunk_bytes=1)
    assert [len(chunk) for chunk in jacobian.dense()] == [64, 64, 9], "a chunk has rows of both blocks"
    close(jacobian.gram().tril(), (J.T @ J).tril(), F64)
    close(
        jacobian.kernel([2.0, 3.0]).tril(),
        (J * torch.cat([J.new_full((16,), 2.0), J.new_full((5,), 3.0)]) @ J.T).tril(),
        F64,
    )


def test_blocks_are_computed_again_for_each_product() -> None:
    kept, J = layered(4)
    calls = []

    def blocks() -> list[list[LayerRows]]:
        calls.append(1)
        return [list(block) for block in kept.blocks()]

    jacobian = LayeredJacobian(blocks, kept.rows, kept.group_sizes, kept.device)
    assert not calls
    close(jacobian.mv(torch.ones(J.shape[1], dtype=F64)), J.sum(1), F64)
    close(jacobian.tmv(torch.ones(len(J), dtype=F64)), J.sum(0), F64)
    assert len(calls) == 2


def test_rows_of_zeros_are_not_multiplied(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, J = layered(5, [(20, True), (8, False)])
    acting = torch.arange(28) % 4 == 0
    acting[20:] = True
    scales = [part.to(F64) for part in acting.split([20, 8])]
    blocks = [[layer.times(s) for layer in block] for block, s in zip(whole.blocks(), scales, strict=True)]
    jacobian = LayeredJacobian(lambda: blocks, whole.rows, whole.group_sizes, whole.device)
    multiplied: list[int] = []

    def counted(chunks: Iterable[Tensor], size: int, like: Tensor) -> Tensor:
        return gram((multiplied.append(len(chunk)) or chunk for chunk in chunks), size, like)

    monkeypatch.setattr(module, "gram", counted)
    close(jacobian.gram().tril(), (J[acting].T @ J[acting]).tril(), F64)
    assert multiplied == [13]


@pytest.mark.parametrize("tangents", [True, False])
@few
@seeds
def test_rows_of_a_layer(tangents: bool, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    layer = layer_rows(generator, 7, 3, 4, tangents)
    J = multiplied_out(layer)
    scale = randn(generator, 7)
    close(multiplied_out(layer.times(scale)), scale[:, None] * J, F64)
    close(multiplied_out(layer.take(torch.tensor([5, 1]))), J[[5, 1]], F64)
    units = torch.tensor([3, 1])
    weights, biases = J[:, :12].view(7, 4, 3)[:, units], J[:, 12:][:, units]
    close(multiplied_out(layer.into(units)), torch.cat([weights.flatten(1), biases], 1), F64)
    assert layer.size == J.shape[1]
    assert layer.bytes == 8 * 7 * (3 + 4) * (2 if tangents else 1)


@pytest.mark.parametrize("mine", [True, False])
@pytest.mark.parametrize("theirs", [True, False])
def test_kernel_between_different_rows(mine: bool, theirs: bool) -> None:
    generator = torch.Generator().manual_seed(5)
    a, b = layer_rows(generator, 6, 3, 2, mine), layer_rows(generator, 4, 3, 2, theirs)
    close(a.kernel(b), multiplied_out(a) @ multiplied_out(b).T, F64)
