"""Damped linear least squares: Jacobians as operators, metrics, and solvers; knows no geometry."""

from collections.abc import Callable

from gnrecon.linalg.auto import Auto
from gnrecon.linalg.cholesky import Cholesky
from gnrecon.linalg.gmres import gmres
from gnrecon.linalg.iterative import Iterative
from gnrecon.linalg.jacobian import Block, DenseJacobian, Jacobian, LayeredJacobian
from gnrecon.linalg.kronecker import Kronecker
from gnrecon.linalg.krylov import KrylovResult, conjugate_gradients
from gnrecon.linalg.metric import Metric, identity, jacobian_scaled, layer_scaled
from gnrecon.linalg.minres import minres
from gnrecon.linalg.nystrom import Nystrom
from gnrecon.linalg.preconditioner import BlockJacobi, Jacobi, Preconditioner, Prepared
from gnrecon.linalg.qr import QR
from gnrecon.linalg.row_space import RowSpace
from gnrecon.linalg.rows import LayerRows
from gnrecon.linalg.sampled_gram import SampledGram, Sketch
from gnrecon.linalg.system import DampedSystem, LinearSolver, Step

SOLVERS: dict[str, Callable[[], LinearSolver]] = {
    "auto": Auto,
    "cholesky": Cholesky,
    "qr": QR,
    "row-space": RowSpace,
    "cg-jacobi": lambda: Iterative("cg", Jacobi()),
    "cg-block-jacobi": lambda: Iterative("cg", BlockJacobi()),
    "cg-nystrom": lambda: Iterative("cg", Nystrom(100)),
    "cg-sampled": lambda: Iterative("cg", SampledGram(4000)),
    "cg-kronecker": lambda: Iterative("cg", Kronecker()),
    "minres": lambda: Iterative("minres", Jacobi()),
    "gmres": lambda: Iterative("gmres", Jacobi()),
    "sketched": lambda: Iterative("cg", Sketch()),
}
"""Makes each solver by its name; "cg-kronecker" needs a `LayeredJacobian`."""

__all__ = [
    "QR",
    "SOLVERS",
    "Auto",
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
    "jacobian_scaled",
    "layer_scaled",
    "minres",
]
