"""Nonlinear least squares: Gauss-Newton with several step controls, Adam and L-BFGS. Independent of geometry."""

from collections.abc import Callable

from gnrecon.optim.first_order import LBFGS, Adam
from gnrecon.optim.gauss_newton import GaussNewton
from gnrecon.optim.loop import Callback, Optimiser, Record, RunMonitor, Solution, StopRule, ValidationLoss
from gnrecon.optim.problem import Problem, ProblemAt
from gnrecon.optim.step_control import FixedStep, GainRatioDamping, LogLineSearch, Move, Search

OPTIMISERS: dict[str, Callable[[], Optimiser]] = {
    "gn": lambda: GaussNewton(GainRatioDamping()),
    "adam": Adam,
    "lbfgs": LBFGS,
}
"""Creates each optimiser by its name."""

__all__ = [
    "LBFGS",
    "OPTIMISERS",
    "Adam",
    "Callback",
    "FixedStep",
    "GainRatioDamping",
    "GaussNewton",
    "LogLineSearch",
    "Move",
    "Optimiser",
    "Problem",
    "ProblemAt",
    "Record",
    "RunMonitor",
    "Search",
    "Solution",
    "StopRule",
    "ValidationLoss",
]
