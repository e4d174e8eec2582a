"""Nonlinear least squares: Gauss-Newton and its ways of choosing a step, Adam and L-BFGS; knows no geometry."""

from collections.abc import Callable

from gnrecon.optim.first_order import LBFGS, Adam
from gnrecon.optim.gauss_newton import GaussNewton
from gnrecon.optim.loop import Callback, HeldOut, Optimiser, Record, Solution, StopRule, Watch
from gnrecon.optim.problem import Problem, ProblemAt
from gnrecon.optim.step_control import FixedStep, GainRatioDamping, LogLineSearch, Move, Search

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
