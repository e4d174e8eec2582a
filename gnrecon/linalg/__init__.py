"""Damped linear least squares: Jacobians as operators, metrics, and solvers; knows no geometry."""

from collections.abc import Callable

from gnrecon.linalg.auto import Auto
from gnrecon.linalg.averaged import Averaged
from gnrecon.linalg.cholesky import Cholesky
from gnrecon.linalg.gmres import gmres
from gnrecon.linalg.iterative import Iterative
from gnrecon.linalg.jacobian import Block, DenseJacobian, Jacobian, LayeredJacobian
from gnrecon.linalg.kronecker import Kronecker
from gnrecon.linalg.krylov import KrylovResult, conjugate_gradients
from gnrecon.linalg.metric import Metric, identity, jacobian_layer_scaled, jacobian_scaled, layer_scaled
from gnrecon.linalg.minres import minres
from gnrecon.linalg.neighbours import Neighbours
from gnrecon.linalg.nystrom import Nystrom
from gnrecon.linalg.preconditioner import BlockJacobi, Jacobi, Preconditioner, Prepared
from gnrecon.linalg.qr import QR
from gnrecon.linalg.row_space import RowSpace
from gnrecon.linalg.rows import LayerRows
from gnrecon.linalg.sampled_gram import SampledGram, Sketch
from gnrecon.linalg.system import DampedSystem, LinearSolver, Step

SOLVERS: dict[str, Callable[..., LinearSolver]] = {
    "auto": lambda energy=0.0: Auto(energy),
    "cholesky": lambda energy=0.0: Cholesky(),  # noqa: ARG005 (one signature for all)
    "qr": lambda energy=0.0: QR(),  # noqa: ARG005
    "row-space": lambda energy=0.0: RowSpace(),  # noqa: ARG005
    "cg-jacobi": lambda energy=0.0: Iterative("cg", Jacobi(), energy=energy),
    "cg-block-jacobi": lambda energy=0.0: Iterative("cg", BlockJacobi(), energy=energy),
    "cg-nystrom": lambda energy=0.0: Iterative("cg", Nystrom(100), energy=energy),
    "cg-neighbours": lambda energy=0.0: Iterative("cg", Neighbours(), energy=energy),
    "cg-sampled": lambda energy=0.0: Iterative("cg", SampledGram(4000), energy=energy),
    "cg-kronecker": lambda energy=0.0: Iterative("cg", Kronecker(), energy=energy),
    "minres": lambda energy=0.0: Iterative("minres", Jacobi()),  # noqa: ARG005
    "gmres": lambda energy=0.0: Iterative("gmres", Jacobi()),  # noqa: ARG005
    "sketched": lambda energy=0.0: Iterative("cg", Sketch(), energy=energy),
}
"""Makes each solver by its name.

`energy` is where conjugate gradients stop, see `Iterative`; "cg-kronecker" needs a `LayeredJacobian`.
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
    "Neighbours",
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
    "minres",
]
