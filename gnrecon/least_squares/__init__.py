"""Damped linear least squares: Jacobians as operators, metrics, and solvers. Independent of geometry."""

from collections.abc import Callable

from gnrecon.least_squares.auto import Auto
from gnrecon.least_squares.direct import QR, Averaged, Cholesky, RowSpace
from gnrecon.least_squares.iterative import Iterative
from gnrecon.least_squares.jacobian import Block, DenseJacobian, Jacobian
from gnrecon.least_squares.kronecker import Kronecker
from gnrecon.least_squares.krylov import KrylovResult, conjugate_gradients
from gnrecon.least_squares.layer_products import LayerRows
from gnrecon.least_squares.layered_jacobian import LayeredJacobian
from gnrecon.least_squares.neighbour_sums import NeighbourSums
from gnrecon.least_squares.paper_solvers import BlockJacobi, Nystrom, gmres
from gnrecon.least_squares.preconditioners import (
    Jacobi,
    Preconditioner,
    Prepared,
    SampledGram,
    Sketch,
)
from gnrecon.least_squares.system import (
    DampedSystem,
    LinearSolver,
    Metric,
    Step,
    identity,
    jacobian_layer_scaled,
    jacobian_scaled,
    layer_scaled,
)

SOLVERS: dict[str, Callable[..., LinearSolver]] = {
    "auto": lambda energy=0.0: Auto(energy),
    "cholesky": lambda energy=0.0: Cholesky(),  # noqa: ARG005 (one signature for all)
    "qr": lambda energy=0.0: QR(),  # noqa: ARG005
    "row-space": lambda energy=0.0: RowSpace(),  # noqa: ARG005
    "cg-jacobi": lambda energy=0.0: Iterative("cg", Jacobi(), energy=energy),
    "cg-block-jacobi": lambda energy=0.0: Iterative("cg", BlockJacobi(), energy=energy),
    "cg-nystrom": lambda energy=0.0: Iterative("cg", Nystrom(100), energy=energy),
    "cg-neighbours": lambda energy=0.0: Iterative("cg", NeighbourSums(), energy=energy),
    "cg-sampled": lambda energy=0.0: Iterative("cg", SampledGram(4000), energy=energy),
    "cg-kronecker": lambda energy=0.0: Iterative("cg", Kronecker(), energy=energy),
    "gmres": lambda energy=0.0: Iterative("gmres", Jacobi()),  # noqa: ARG005
    "sketched": lambda energy=0.0: Iterative("cg", Sketch(), energy=energy),
}
"""Creates each solver by its name.

`energy` is the stopping tolerance of conjugate gradients, see `Iterative`; "cg-kronecker" needs a `LayeredJacobian`.
"""

__all__ = [
    "QR",
    "SOLVERS",
    "Auto",
    "Averaged",
    "Block",
    "BlockJacobi",
    "Cholesky",
    "DampedSystem",
    "DenseJacobian",
    "Iterative",
    "Jacobi",
    "Jacobian",
    "Kronecker",
    "KrylovResult",
    "LayerRows",
    "LayeredJacobian",
    "LinearSolver",
    "Metric",
    "NeighbourSums",
    "Nystrom",
    "Preconditioner",
    "Prepared",
    "RowSpace",
    "SampledGram",
    "Sketch",
    "Step",
    "conjugate_gradients",
    "gmres",
    "identity",
    "jacobian_layer_scaled",
    "jacobian_scaled",
    "layer_scaled",
]
