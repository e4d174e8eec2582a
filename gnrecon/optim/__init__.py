"""Nonlinear least squares: Gauss-Newton and its ways of choosing a step, Adam and L-BFGS; knows no geometry."""

from collections.abc import Callable

from gnrecon.optim.adam import Adam
from gnrecon.optim.damping import GainRatioDamping
from gnrecon.optim.gauss_newton import GaussNewton
from gnrecon.optim.lbfgs import LBFGS
from gnrecon.optim.line import FixedStep, LogLineSearch
from gnrecon.optim.optimiser import Optimiser
from gnrecon.optim.problem import Problem, ProblemAt
from gnrecon.optim.search import Move, Search
from gnrecon.optim.solution import Callback, Record, Solution
from gnrecon.optim.stop import HeldOut, StopRule, Watch

OPTIMISERS: dict[str, Callable[[], Optimiser]] = {
    "gn": lambda: GaussNewton(GainRatioDamping()),
    "adam": Adam,
    "lbfgs": LBFGS,
}
"""Makes each optimiser by its name."""

__all__ = [
    "LBFGS",
    "OPTIMISERS",
    "Adam",
    "Callback",
    "FixedStep",
    "GainRatioDamping",
    "GaussNewton",
    "HeldOut",
    "LogLineSearch",
    "Move",
    "Optimiser",
    "Problem",
    "ProblemAt",
    "Record",
    "Search",
    "Solution",
    "StopRule",
    "Watch",
]
