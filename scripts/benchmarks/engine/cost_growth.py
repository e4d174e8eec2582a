"""How the engine's cost grows with the number of points N and of parameters p.

At N points (2 N + N / 2 rows) of a 3 x 32 network, and at p parameters of three equal layers with fixed rows, in
float64: seconds of making the factors of J's rows (`linearise`), and with that of J^T J (`gram`), of J^T (J v)
(`product`) and of J J^T (`kernel`). A series ends before a matrix is too large, or the time is up.
Exponents are the slopes of straight lines through the logarithms, by least squares, of times of
at least 0.02 seconds.

J^T J is symmetric, so that assembly needs M p (p + 1) additions and multiplications; over its seconds, that is compared
with the machine's own rate in a product of two square matrices."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch

from benchmarks.engine.paper_loss import posed, sphere
from benchmarks.harness.measurement import timed
from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem
from gnrecon.least_squares import Jacobian


def sizes() -> tuple[int, ...]:
    """Return a thousand to a million in half powers of ten."""
    return tuple(round(10**power) for power in np.arange(3.0, 6.01, 0.5))


@dataclass(frozen=True)
class CostSettings:
    """Sizes of the measured problems.

    Parameters
    ----------
    points, parameters : sizes of the two growths
    widths : of the network whose points grow
    fixed_points, fixed_volume : points of the networks that grow
    matmul : rows of the matrices whose product gives the machine's rate
    matrix_bytes : largest matrix
    short_seconds : shorter calls are timed three times
    """

    points: Sequence[int] = field(default_factory=sizes)
    parameters: Sequence[int] = field(default_factory=sizes)
    widths: tuple[int, ...] = (32, 32, 32)
    fixed_points: int = 2000
    fixed_volume: int = 1000
    matmul: int = 4096
    matrix_bytes: int = 2_000_000_000
    short_seconds: float = 1.0


@dataclass(frozen=True)
class Operation:
    """An operation on a Jacobian, the bytes of its matrix for M rows and p columns, and its exponents.

    The exponents in N and in p are those of its arithmetic; J J^T costs the network's width, sqrt(p), for each entry.
    """

    run: Callable[[Jacobian], object]
    bytes: Callable[[int, int], int]
    exponents: dict[str, float]


# The cheapest first, so that the most time is left for the most expensive.
OPERATIONS = {
    "product": Operation(
        lambda jacobian: jacobian.tmv(jacobian.mv(torch.ones(jacobian.columns, dtype=jacobian.dtype))),
        lambda *_: 0,
        {"by_parameters": 1.0, "by_points": 1.0},
    ),
    "kernel": Operation(
        lambda jacobian: jacobian.kernel(),
        lambda rows, _: 8 * rows**2,
        {"by_parameters": 0.5, "by_points": 2.0},
    ),
    "gram": Operation(
        lambda jacobian: jacobian.gram(),
        lambda _, columns: 8 * columns**2,
        {"by_parameters": 2.0, "by_points": 1.0},
    ),
}


def measure_cost(seconds: float, settings: CostSettings) -> dict[str, Any]:
    """Return both growths, of the problems that fit into so many seconds in all, and the rate of a matrix product."""
    rate, deadline = matmul_rate(settings.matmul), perf_counter() + seconds
    problems = {
        "by_parameters": [(count, partial(_at_parameters, count, settings)) for count in settings.parameters],
        "by_points": [(count, partial(_at_points, count, settings)) for count in settings.points],
    }
    found: dict[str, Any] = {growth: {} for growth in problems}
    for name, operation in OPERATIONS.items():
        for growth, cases in problems.items():
            measured = list(_measurements(operation, operation.exponents[growth], cases, deadline, settings))
            if name == "gram":
                _add_shares(measured, rate)
            slope = exponent([entry["size"] for entry in measured], [entry["seconds"] for entry in measured])
            found[growth][name] = {"exponent": slope, "measured": measured}
    return {"matmul_gflops": rate / 1e9, **found}


def matmul_rate(size: int) -> float:
    """Return additions and multiplications a second of a float64 product of two square matrices."""
    A = torch.rand(size, size, dtype=torch.float64)
    return 2 * size**3 / median(timed(lambda: A @ A)[0] for _ in range(3))


def width_for(parameters: int) -> int:
    """Return the width w of three equal layers with about so many parameters: 2 w^2 + 7 w + 1 of them."""
    return max(1, round((math.sqrt(49 + 8 * (parameters - 1)) - 7) / 4))


def exponent(sizes: Sequence[float], values: Sequence[float], *, least: float = 0.02) -> float | None:
    """Return the slope of log(value) over log(size) by least squares, or None from fewer than two values of `least`.

    Calls of fewer than 0.02 seconds cost more than their arithmetic.
    """
    pairs = [(size, value) for size, value in zip(sizes, values, strict=True) if value >= least]
    if len(pairs) < 2:
        return None
    x, y = np.log(np.array(pairs)).T
    return float(np.polyfit(x, y, 1)[0])


def _at_points(count: int, settings: CostSettings) -> FieldProblem:
    return _problem(settings.widths, count, count // 2)


def _at_parameters(count: int, settings: CostSettings) -> FieldProblem:
    return _problem((width_for(count),) * 3, settings.fixed_points, settings.fixed_volume)


def _problem(widths: tuple[int, ...], points: int, volume: int) -> FieldProblem:
    field = Siren(widths)
    return posed(field, field.initial(torch.Generator().manual_seed(0)), sphere(points, volume))


def _measurements(
    operation: Operation,
    growth: float,
    cases: Sequence[tuple[int, Callable[[], FieldProblem]]],
    deadline: float,
    settings: CostSettings,
) -> Iterator[dict[str, Any]]:
    last: tuple[int, float] | None = None
    for size, make in cases:
        problem = make()
        rows, columns = 2 * len(problem.terms[0]) + len(problem.terms[2]), len(problem.theta)
        expected = 0.0 if last is None else last[1] * (size / last[0]) ** growth
        if operation.bytes(rows, columns) > settings.matrix_bytes or perf_counter() + expected > deadline:
            return
        entry = _measure(operation, problem, settings.short_seconds)
        last = size, entry["seconds"]
        yield entry | {"size": size, "rows": rows, "parameters": columns}


def _add_shares(measured: Sequence[dict[str, Any]], rate: float) -> None:
    for entry in measured:
        flops = entry["rows"] * entry["parameters"] * (entry["parameters"] + 1)
        entry["share_of_matmul"] = flops / entry["operation_seconds"] / rate


def _measure(operation: Operation, problem: FieldProblem, short_seconds: float) -> dict[str, Any]:
    """Return the seconds of linearising, of the operation, and of both, medians of three if they are short."""
    times: list[tuple[float, float]] = []
    while not times or (len(times) < 3 and sum(times[0]) < short_seconds):
        seconds, (jacobian, _) = timed(lambda: problem.linearise(problem.theta))
        times.append((seconds, timed(partial(operation.run, jacobian))[0]))
    linearise, own = (median(column) for column in zip(*times, strict=True))
    return {"linearise_seconds": linearise, "operation_seconds": own, "seconds": linearise + own}
