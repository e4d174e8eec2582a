"""Where the edges of a grid pierce a level set, each with the area that it stands for.

The nodes of a cubic grid of spacing h, shifted at random, are evaluated where f may be zero, and every edge whose
ends differ in sign holds a crossing. It is found by binary search, sped up: the point tried is that of regula falsi,
and an end that is kept twice counts half (the Illinois rule), so that the bracket never opens and few tries are enough.

The crossings are no uniform sample. Lines along axis i, one for each h^2, meet a piece of surface with unit normal n
in proportion to its shadow |n_i|; all three families meet it |n_1| + |n_2| + |n_3| times for each h^2. As the shift is
uniform this holds without bias, so that crossings weighted by

    w = h^2 / (|n_1| + |n_2| + |n_3|)

are an unbiased quadrature of the area measure, and their sum is an unbiased estimate of the area (Crofton's formula
of integral geometry for three families of lines; Santalo, Integral Geometry and Geometric Probability, 1976).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from gnrecon.level_set.level_set import LevelSet
from gnrecon.runtime.parallel import set_threads

_TRIES = 4

_BLOCK = 3

_REACH = 1.5


@dataclass(frozen=True)
class Crossings:
    """Points near the level set, on grid edges, in no particular order; there may be none.

    Parameters
    ----------
    points : of shape (N, 3)
    normals : unit, of shape (N, 3)
    areas : w, of shape (N,), in squared units of the coordinates
    spacing : h
    """

    points: Tensor
    normals: Tensor
    areas: Tensor
    spacing: float


def find_crossings(level_set: LevelSet, nodes: int, rng: np.random.Generator) -> Crossings:
    """Search a grid of about `nodes` nodes over the level set's box, shifted at random, for crossings.

    Values that are not finite bound no crossing, and a crossing at which the gradient vanishes is left out.
    """
    sides = level_set.box.upper - level_set.box.lower
    spacing = float(np.prod(sides) / nodes) ** (1 / 3)
    grid = _shifted_nodes(level_set, spacing, rng)
    values = near_values(level_set, grid)
    below, above, at_below, at_above = _brackets(grid, values)
    points = _search(level_set, below, above, at_below, at_above)
    points = points[level_set.contains(points)]
    gradients = level_set.values_and_gradients(points)[1]
    lengths = torch.linalg.vector_norm(gradients, dim=1)
    usable = lengths.isfinite() & (lengths > torch.finfo(lengths.dtype).tiny)
    normals = gradients[usable] / lengths[usable, None]
    return Crossings(points[usable], normals, spacing**2 / normals.abs().sum(1), spacing)


def _shifted_nodes(level_set: LevelSet, spacing: float, rng: np.random.Generator) -> Tensor:
    """Return the nodes, of shape (I, J, K, 3), of a grid that of whole blocks that reaches beyond the box."""
    lower, upper = level_set.box.lower, level_set.box.upper
    first = lower - spacing * rng.uniform(size=3)
    # Whole blocks, of which the last node begins the next one.
    counts = _BLOCK * np.ceil((upper - first) / (_BLOCK * spacing)).astype(int) + 1
    axes = [level_set.tensor(start + spacing * np.arange(n)) for start, n in zip(first, counts, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def near_values(level_set: LevelSet, grid: Tensor) -> Tensor:
    """Return f at the nodes, of shape (I, J, K, 3), of all blocks where it may be zero; no number elsewhere.

    Blocks of 3 x 3 x 3 cells are judged by their corners: f may be zero in one if the least |f| there is at most 1.5
    times the largest change of f along an edge of it or of its neighbours. For a distance these are the blocks nearer
    than 1.5 of their sides, where a half of sqrt(3) would do.
    """
    corners = grid[::_BLOCK, ::_BLOCK, ::_BLOCK]
    coarse = level_set.rough_values(corners.reshape(-1, 3)).reshape(corners.shape[:-1])
    wanted = _nodes_of(_may_hold_zero(coarse), grid.shape[:-1])
    values = torch.full(grid.shape[:-1], torch.nan, dtype=grid.dtype, device=grid.device)
    values[wanted] = level_set.rough_values(grid[wanted])
    return values


def _may_hold_zero(coarse: Tensor) -> Tensor:
    """Return for each block, (I, J, K), whether f may be zero in it, from f at the corners, (I + 1, J + 1, K + 1)."""
    sizes = torch.zeros_like(coarse)
    for axis in range(3):
        change = coarse.diff(dim=axis).abs().nan_to_num(torch.inf)
        # Both ends of an edge learn of its change.
        for ends in (slice(0, -1), slice(1, None)):
            part = [slice(None)] * 3
            part[axis] = ends
            sizes[tuple(part)] = torch.maximum(sizes[tuple(part)], change)
    change = _largest(_largest(sizes, 3, 1), 2, 0)
    least = -_largest(-coarse.abs().nan_to_num(torch.inf), 2, 0)
    return least <= _REACH * change


def _largest(values: Tensor, size: int, padding: int) -> Tensor:
    """Return the largest value in each cube of `size` nodes a side."""
    return torch.nn.functional.max_pool3d(values[None, None], size, stride=1, padding=padding)[0, 0]


def _nodes_of(blocks: Tensor, shape: torch.Size) -> Tensor:
    """Return which nodes of the grid, of `shape`, belong to the marked blocks, their far faces included."""
    nodes = torch.zeros(shape, dtype=torch.bool, device=blocks.device)
    i, j, k = (_BLOCK * index for index in blocks.nonzero().T)
    steps = range(_BLOCK + 1)
    for a, b, c in ((a, b, c) for a in steps for b in steps for c in steps):
        nodes[i + a, j + b, k + c] = True
    return nodes


def _brackets(grid: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the ends where f < 0 and where f >= 0 of all edges that have both, each (N, 3), and f there, (N,)."""
    negative, finite = values < 0, values.isfinite()
    found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for axis in range(3):
        size = values.shape[axis] - 1
        near = [slice(None)] * 3
        far = [slice(None)] * 3
        near[axis], far[axis] = slice(0, size), slice(1, size + 1)
        a, b = tuple(near), tuple(far)
        for low, high in ((a, b), (b, a)):
            edges = negative[low] & ~negative[high] & finite[low] & finite[high]
            found.append((grid[low][edges], grid[high][edges], values[low][edges], values[high][edges]))
    below, above, at_below, at_above = (torch.cat(parts) for parts in zip(*found, strict=True))
    return below, above, at_below, at_above


def _search(level_set: LevelSet, below: Tensor, above: Tensor, at_below: Tensor, at_above: Tensor) -> Tensor:
    """Return points, of shape (N, 3), in brackets narrowed by the Illinois rule."""
    # Places on the edge, from 0 at its lower end to 1 at its upper one.
    low, high = torch.zeros_like(at_below), torch.ones_like(at_below)
    f_low, f_high = at_below.clone(), at_above.clone()
    edge = above - below
    place = _false_position(low, high, f_low, f_high)
    was_low = torch.full_like(place, torch.nan)
    for _ in range(_TRIES):
        value = level_set.rough_values(below + place[:, None] * edge)
        is_low = value < 0
        again = was_low == is_low
        # An end that stays while the other one moves twice counts half, so that the next try lands beyond the zero.
        f_high = torch.where(is_low, torch.where(again, f_high / 2, f_high), value)
        f_low = torch.where(is_low, value, torch.where(again, f_low / 2, f_low))
        low, high = torch.where(is_low, place, low), torch.where(is_low, high, place)
        was_low = is_low.to(place.dtype)
        place = _false_position(low, high, f_low, f_high)
    return below + place[:, None] * edge


def _false_position(low: Tensor, high: Tensor, f_low: Tensor, f_high: Tensor) -> Tensor:
    """Return where the chord between (low, f_low < 0) and (high, f_high >= 0) is zero."""
    share = f_low / (f_low - f_high).clamp_max(-torch.finfo(f_low.dtype).tiny)
    return low + share.clamp(0.0, 1.0) * (high - low)


TOLERANCE = 1e-14
"""Distance from the level set, in diagonals of the box, at which a point counts as on it, unless rounding forbids."""

_ROUNDING = 20 * TOLERANCE

_QUADRATIC = 5


# Orthogonal Newton projection: along the gradient onto the level set, and to the nearest point of it.
#
# The first-order expansion of f along its own gradient g vanishes after the step
#
#     x  <-  x - f g / |g|^2,
#
# which the paper uses to refine surface samples (its appendix on surface sampling, after Chopp, Some improvements of
# the fast marching method, 2001). It is quadratic near the surface. Far from it, or where g is small, the step is a
# wild guess, so its length is capped; at a critical point, where there is no direction at all, the point stays where it
# is and is reported as not converged. No division is by zero.
#
# The point of the level set that is *nearest* to a given q satisfies more: q - x is parallel to g there. Each step
# takes for x the foot of q on the tangent plane of f's level at x,
#
#     x  <-  q - (f + g . (q - x)) g / |g|^2,
#
# whose fixed points are those feet; it contracts by (distance of q) x (curvature), so it is for points near the
# surface.


@dataclass(frozen=True)
class Projection:
    """Points after a projection.

    Parameters
    ----------
    points : of shape (N, 3)
    gradients : grad f there, of shape (N, 3)
    distances : f / |grad f| there, of shape (N,): the distance that is left, to first order, with its sign
    converged : of shape (N,), whether it is as good as zero
    """

    points: Tensor
    gradients: Tensor
    distances: Tensor
    converged: Tensor


def newton_step(level_set: LevelSet, points: Tensor, cap: float) -> Projection:
    """Return points, of shape (N, 3), after one step of at most `cap`; gradients and distances are those before it."""
    value, gradient = level_set.values_and_gradients(points)
    distance, normal = _measured(value, gradient)
    moved = points - distance.clamp(-cap, cap)[:, None] * normal
    return Projection(moved, gradient, distance, _is_on(distance, level_set, TOLERANCE))


def project(level_set: LevelSet, points: Tensor, cap: float, iterations: int = 30) -> Projection:
    """Move points, of shape (N, 3), along the gradient onto the level set, each step by at most `cap`.

    Points that have not arrived after `iterations` steps, or that met a critical point, are not `converged`.
    """
    points = points.clone()
    value, gradient = level_set.values_and_gradients(points)
    distance = _measured(value, gradient)[0]
    for number in range(iterations):
        # Steps that only stir the rounding errors are not worth their evaluations.
        active = (~_is_on(distance, level_set, TOLERANCE if number < _QUADRATIC else _ROUNDING)).nonzero()[:, 0]
        if not len(active):
            break
        before, normal = _measured(value[active], gradient[active])
        points[active] -= before.clamp(-cap, cap)[:, None] * normal
        value[active], gradient[active] = level_set.values_and_gradients(points[active])
        distance[active] = _measured(value[active], gradient[active])[0]
    return Projection(points, gradient, distance, _is_on(distance, level_set, _ROUNDING))


def nearest(level_set: LevelSet, queries: Tensor, starts: Tensor, cap: float, iterations: int = 50) -> Projection:
    """Find the feet of `queries`, of shape (N, 3), on the level set near `starts`, of the same shape.

    A foot is `converged` where it lies on the level set and moved no more; it is then a point of the level set whose
    gradient points to the query, and the nearest one if the start was near it.
    """
    points = project(level_set, starts, cap).points
    moved = torch.full_like(points[:, 0], torch.inf)
    for _ in range(iterations):
        active = (moved > TOLERANCE * level_set.diagonal).nonzero()[:, 0]
        if not len(active):
            break
        step = _foot_step(level_set, queries[active], points[active], cap)
        points[active] += step
        moved[active] = torch.linalg.vector_norm(step, dim=1)
    # What little the last step left of f is no matter of the nearest point any more.
    on = project(level_set, points, cap)
    settled = moved <= 1e-9 * level_set.diagonal
    return Projection(on.points, on.gradients, on.distances, on.converged & settled)


def _foot_step(level_set: LevelSet, queries: Tensor, points: Tensor, cap: float) -> Tensor:
    """Return the step from x to the foot of q on the tangent plane at x, at most `cap` long, of shape (N, 3)."""
    value, gradient = level_set.values_and_gradients(points)
    distance, normal = _measured(value, gradient)
    toward = queries - points
    step = toward - ((normal * toward).sum(1) + distance)[:, None] * normal
    length = torch.linalg.vector_norm(step, dim=1, keepdim=True)
    capped: Tensor = torch.where(distance[:, None].isfinite(), step, 0.0) * (cap / length.clamp_min(cap))
    return capped


def _measured(value: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Return f / |g|, of shape (N,), infinite where g vanishes, and g / |g|, of shape (N, 3), zero there."""
    length = torch.linalg.vector_norm(gradient, dim=1)
    # Twice, because the inverse of a subnormal length would overflow.
    defined = (length > torch.finfo(length.dtype).tiny) & value.isfinite() & length.isfinite()
    safe = torch.where(defined, length, 1.0)
    normal = torch.where(defined[:, None], gradient / safe[:, None], 0.0)
    return torch.where(defined, value / safe, torch.inf), normal


def _is_on(distance: Tensor, level_set: LevelSet, tolerance: float) -> Tensor:
    return distance.abs() <= tolerance * level_set.diagonal


Input = TypeVar("Input")

Answer = TypeVar("Answer")


# Work that runs beside the caller's, on what the caller had one call ago.
#
# An answer that is computed in another thread would usually be taken whenever it is there, and a run would depend on
# how busy the machine is. Here the lag is fixed: each call hands over a new input and returns the answer to the one
# before, for which it waits if need be. So the same run gives the same result, and as long as the work takes no longer
# than what the caller does between two calls, it costs nothing but a processor that was idle. What does the work must
# release Python's lock while it does, as torch and gudhi do.


class Beside(Generic[Input, Answer]):
    """One worker for one function; use it in a `with` statement, which ends the worker.

    Parameters
    ----------
    work : a function of nothing but its input, which must not change any more once it is handed over
    """

    def __init__(self, work: Callable[[Input], Answer]) -> None:
        self._work = work
        # As many of torch's threads as the one that asks has.
        self._pool = ThreadPoolExecutor(1, initializer=set_threads, initargs=(torch.get_num_threads(),))
        self._last: Future[Answer] | None = None

    def __call__(self, current: Input) -> Answer:
        """Hand over an input and return the answer to the previous one; at the first call, that to this one."""
        following = self._pool.submit(self._work, current)
        previous, self._last = self._last, following
        return (previous or following).result()

    def __enter__(self) -> Beside[Input, Answer]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
