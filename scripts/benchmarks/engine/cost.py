"""How the engine's cost grows with the number of points N and of parameters p.

At N points (2 N + N / 2 rows) of a 3 x 32 network, and at p parameters of three equal layers with fixed rows, in
float64: seconds of making the factors of J's rows (`linearise`), and with that of J^T J (`gram`), of J^T (J v)
(`product`) and of J J^T (`kernel`). A series ends before what would not fit MATRIX_BYTES or the time that is left.
Exponents are the slopes of straight lines through the logarithms, by least squares, of what took at least FLOOR
seconds, below which calls cost more than arithmetic.

J^T J is symmetric, so that assembly needs M p (p + 1) additions and multiplications; over its seconds, that is compared
with the machine's own rate in a product of two square matrices of MATMUL rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch

from benchmarks.engine.clock import timed
from benchmarks.engine.loss import posed
from benchmarks.engine.scans import sphere
from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem
from gnrecon.least_squares import Jacobian

MATMUL = 4096
MATRIX_BYTES = 2_000_000_000
FLOOR = 0.02
SHORT = 1.0
"""What takes less, in seconds, is timed three times."""

POINTS = tuple(round(10**power) for power in np.arange(3.0, 6.01, 0.5))
PARAMETERS = POINTS
FIXED_POINTS, FIXED_VOLUME = 2000, 1000
WIDTHS = (32, 32, 32)


@dataclass(frozen=True)
class Operation:
    """What is timed on a Jacobian, the bytes of the matrix it makes of M rows and p columns, and its exponents.

    The exponents in N and in p are those of its arithmetic; J J^T costs the network's width, sqrt(p), for each entry.
    """

    run: Callable[[Jacobian], object]
    bytes: Callable[[int, int], int]
    exponents: dict[str, float]


# The cheapest first, so that the time that is left is for the one that needs it.
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


def measure_cost(
    seconds: float, points: Sequence[int] = POINTS, parameters: Sequence[int] = PARAMETERS, matmul: int = MATMUL
) -> dict[str, Any]:
    """Return both growths, of what fits into so many seconds in all, and the rate of a matrix product."""
    rate, deadline = matmul_rate(matmul), perf_counter() + seconds
    problems = {
        "by_parameters": [(count, partial(_at_parameters, count)) for count in parameters],
        "by_points": [(count, partial(_at_points, count)) for count in points],
    }
    found: dict[str, Any] = {growth: {} for growth in problems}
    for name, operation in OPERATIONS.items():
        for growth, cases in problems.items():
            measured = list(_measurements(operation, operation.exponents[growth], cases, deadline))
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


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float | None:
    """Return the slope of log(seconds) over log(size) by least squares, or None from less than two above FLOOR."""
    pairs = [(size, value) for size, value in zip(sizes, seconds, strict=True) if value >= FLOOR]
    if len(pairs) < 2:
        return None
    x, y = np.log(np.array(pairs)).T
    return float(np.polyfit(x, y, 1)[0])


def _at_points(count: int) -> FieldProblem:
    return _problem(WIDTHS, count, count // 2)


def _at_parameters(count: int) -> FieldProblem:
    return _problem((width_for(count),) * 3, FIXED_POINTS, FIXED_VOLUME)


def _problem(widths: tuple[int, ...], points: int, volume: int) -> FieldProblem:
    field = Siren(widths)
    return posed(field, field.initial(torch.Generator().manual_seed(0)), sphere(points, volume))


def _measurements(
    operation: Operation, growth: float, cases: Sequence[tuple[int, Callable[[], FieldProblem]]], deadline: float
) -> Iterator[dict[str, Any]]:
    last: tuple[int, float] | None = None
    for size, make in cases:
        problem = make()
        rows, columns = 2 * len(problem.terms[0]) + len(problem.terms[2]), len(problem.theta)
        expected = 0.0 if last is None else last[1] * (size / last[0]) ** growth
        if operation.bytes(rows, columns) > MATRIX_BYTES or perf_counter() + expected > deadline:
            return
        entry = _measure(operation, problem)
        last = size, entry["seconds"]
        yield entry | {"size": size, "rows": rows, "parameters": columns}


def _add_shares(measured: Sequence[dict[str, Any]], rate: float) -> None:
    for entry in measured:
        flops = entry["rows"] * entry["parameters"] * (entry["parameters"] + 1)
        entry["share_of_matmul"] = flops / entry["operation_seconds"] / rate


def _measure(operation: Operation, problem: FieldProblem) -> dict[str, Any]:
    """Return the seconds of linearising, of the operation, and of both, medians of three where they are short."""
    times: list[tuple[float, float]] = []
    while not times or (len(times) < 3 and sum(times[0]) < SHORT):
        seconds, (jacobian, _) = timed(lambda: problem.linearise(problem.theta))
        times.append((seconds, timed(partial(operation.run, jacobian))[0]))
    linearise, own = (median(column) for column in zip(*times, strict=True))
    return {"linearise_seconds": linearise, "operation_seconds": own, "seconds": linearise + own}
