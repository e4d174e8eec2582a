"""Gauss-Newton and its ways of choosing a step; knows no geometry."""

from gnrecon.optim.gauss_newton import GaussNewton, StopRule
from gnrecon.optim.problem import Problem
from gnrecon.optim.search import GainRatioDamping, LogLineSearch, Search
from gnrecon.optim.solution import Record, Solution

__all__ = [
    "GainRatioDamping",
    "GaussNewton",
    "LogLineSearch",
    "Problem",
    "Record",
    "Search",
    "Solution",
    "StopRule",
]
