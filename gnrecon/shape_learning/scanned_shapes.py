"""The paper's reconstruction of a scan as a problem of shape learning, so that its optimisers can be compared on it.

Its terms are f = 0 and n . grad f = 1 at the points, both of weight one, and the eikonal constraint in the box around
them; the network has 3 x 32 sine units. The eikonal weight falls from the paper's 1e-2 to a hundredth of that within
some thirteen steps, because it stands against the data, and then is gone where points and normals alone determine the
network: each step would go where its own points of the box want it to. The loss that is reported is that of points and
normals, which the paper's figures are. One term is not the paper's: away from the points, where their winding number
tells the sign, the field keeps it. Without that, steps that are as long as these leave sheets in the free space, of
which neither loss nor points know. The paper begins with a sphere; here it is the cloud's own coarse signed distance
(`sampling`), on features of more than one wavelength, so that there is no plateau.

For a product's sake use `gnrecon.reconstruct`: it fits more finely, and holds the free space.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.field import Network
from gnrecon.field.layers import SINE
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Box, CoarseDistance, free_space_bounds, kd_tree_order
from gnrecon.least_squares import Iterative, LinearSolver, NeighbourSums, Preconditioner, jacobian_layer_scaled
from gnrecon.optim import GainRatioDamping
from gnrecon.residuals import eikonal, free_space, interface, normal_projection
from gnrecon.shape_learning.shape_problem import (
    LAST,
    Drawn,
    Moment,
    Sampler,
    ShapeProblem,
    Start,
    Term,
    Weight,
    at_points,
    fading,
    falling,
    growing,
    in_box,
)

NETWORK = Network((32, 32, 32), SINE, (12.0,))
"""The paper's, with frequencies of the first layer that begin larger."""

POINTS, IN_BOX = growing(1500, 1.25, 5000, 1.012), 1000
"""Points of each term at each step, and those in the box. With 8,000 points of the bunny a quarter of the loss is in
the end owed to fitting those of the last steps better than the others; at first that is little beside what a step
gains.
"""

MARGIN = 0.2
"""The paper's: how far the box reaches beyond the scan, in radii."""

EIKONAL, FALL, LEAST = 1e-2, 0.7, 1e-4
"""Weight of the eikonal term to begin with, its factor from step to step, and the least."""

DETERMINED = 4
"""Residuals of points and normals for each of the network's parameters, from which on the eikonal term is gone once it
has its least weight."""

FREE, POOL, IN_FREE = 1.0, 150_000, 20_000
"""Weight of the free space, points of the box whose sign may be known, and those that are drawn in each step to be
looked at. Hardly any of them has a residual. Once the eikonal term is gone small pockets open far from the points; ten
makes them a fifth as large, but holds the surface up."""

HELD, SETTLED, ASKED = 250, 5e-3, 2000
"""Steps for which the free space is held where points and normals determine the network; root mean square of f at the
points, that many of them asked, above which it is held longer. Then steps hardly move the surface, what the free space
asks costs a sixteenth of the loss that is left, and pockets that grow far from the points are not in the mesh. Adam,
and L-BFGS for long, do not come so near."""

LONGEST, MANY, WAIT, EXACT = 4, 40.0, 8, 0.03
"""Rows that are summed for the preconditioner; iterations a step from which on they are half as many, and steps before
they are so again; and the error of a step in the norm of the damped matrix. With a tenth the same time takes more
steps, and comes less far."""

CLEAR, CLEAR_DISKS = 0.05, 3.0
"""Least distance of such a point from the scan, and in radii of the nearest point's disk: nearer to them than that, the
sign of sparse points is a guess here and there."""

DEEP = 0.01
"""The most that is asked of f there, in magnitude. With 0.05 the rocker arm's loss is higher by a seventh."""


@dataclass(frozen=True)
class ScannedSurface:
    """A surface of which points are known, as what a level set is measured against.

    Parameters
    ----------
    points : of shape (N, 3)
    """

    points: Tensor

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Return about `count` of the points, of shape (M, 3), and the share of each, 1 / M, of shape (M,)."""
        chosen = self.points[:: -(-len(self.points) // count)]
        return chosen, torch.full_like(chosen[:, 0], 1 / len(chosen))

    def nearest(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest points, of shape (N, 3), to queries, (N, 3), all of which count."""
        rows = cKDTree(self.points.numpy()).query(queries.numpy())[1]
        return self.points[torch.as_tensor(rows)], torch.ones(len(queries), dtype=torch.bool)


def scanned(samples: Samples, all_points: Samples | None = None, name: str = "scan", seed: int = 0) -> ShapeProblem:
    """Return the problem of a surface through points with normals.

    Parameters
    ----------
    samples : what the surface is learned from, in the unit ball
    all_points : what it is measured against, in the same frame, by default `samples`
    name : of the problem
    seed : of the coarse distance
    """
    order = kd_tree_order(samples.points)
    samples = replace(samples, points=samples.points[order], normals=samples.normals[order])
    box = Box.around(samples.points, MARGIN)
    coarse = CoarseDistance(samples.points, samples.normals, np.random.default_rng(seed))
    terms = (
        Term("interface", interface, at_points(samples.points, count=POINTS)),
        Term("normal", normal_projection, at_points(samples.points, samples.normals, count=POINTS)),
        Term("eikonal", eikonal, in_box(IN_BOX), _eikonal_weight(2 * len(samples)), 0.0),
        Term("free space", free_space, _free(samples, coarse, box, np.random.default_rng(seed)), FREE, 0.0),
    )
    known = ScannedSurface(torch.as_tensor((all_points or samples).points))
    search = GainRatioDamping(initial_damping=1e-2, metric=jacobian_layer_scaled, geodesic=True)
    return ShapeProblem(
        name,
        terms,
        box,
        _start(coarse),
        NETWORK,
        known,
        search=search,
        solver=by_few_neighbours,
        stored=torch.float32,
    )


def by_few_neighbours() -> LinearSolver:
    """Return conjugate gradients that sums of few neighbouring rows precondition, afresh at each step.

    The network's waves are short, and the dampings small: of the rocker arm's rows after forty steps, runs of four make
    10 iterations and a quarter of J^T J's cost, runs of eight 33, runs of two 4. Later pairs are cheaper than fours,
    and in the end J^T J itself is cheaper than both.
    """
    return Iterative("cg", NeighbourSums(longest=LONGEST), energy=EXACT, reuse=False, adapt=_Shorter())


@dataclass
class _Shorter:
    """Halves the runs, down to single rows, when steps take many iterations; not again before it shows what it does."""

    waited: int = 0

    def __call__(self, preconditioner: Preconditioner, iterations: float) -> Preconditioner:
        """Return the preconditioner of the next step, by the mean number of iterations of the last ones."""
        self.waited += 1
        if not isinstance(preconditioner, NeighbourSums) or iterations <= MANY or self.waited < WAIT:
            return preconditioner
        self.waited = 0
        return replace(preconditioner, longest=max(preconditioner.longest // 2, 1))


def _eikonal_weight(residuals: int) -> Weight:
    """Return the weight at each step, for so many residuals of points and normals."""
    if _determine(residuals):
        return fading(EIKONAL, 0, FALL, LEAST)
    return falling(EIKONAL, FALL, LEAST)


def _determine(residuals: int) -> bool:
    """Return whether so many residuals of points and normals determine the network."""
    return residuals >= DETERMINED * NETWORK.layout.count


def _free(samples: Samples, coarse: CoarseDistance, box: Box, rng: np.random.Generator) -> Sampler:
    """Return a sampler of the points whose sign the field has lost, as long as the free space is held.

    Where that has once been seen is looked at in every step from then on, so that two steps ask for the same.
    """
    asked = torch.as_tensor(samples.points[:: -(-len(samples) // ASKED)])
    held = HELD if _determine(2 * len(samples)) else LAST
    pool = box.sample(POOL, rng)
    known, signed, distance, _ = coarse.at(pool, CLEAR_DISKS)
    clear = distance > CLEAR
    points = torch.as_tensor(pool[known][clear])
    least = torch.as_tensor(free_space_bounds(signed[clear], DEEP))
    watched = torch.zeros(len(points), dtype=torch.bool)

    def draw(moment: Moment) -> Drawn:
        if moment.step == 1:  # a run that begins owes nothing to an earlier one of the same problem
            watched.zero_()
        if moment.step > held and float(moment.level_set.values(asked).square().mean()) < SETTLED**2:
            return Drawn(points[:0], least[:0], share=0.0)
        # A cloud of few points may leave nothing of the box so far from it that its sign is known.
        drawn = moment.rng.integers(len(points), size=IN_FREE if len(points) else 0)
        rows = watched.index_fill(0, torch.as_tensor(drawn), True).nonzero()[:, 0]
        x, targets = points[rows], least[rows]
        lost = targets.sign() * (moment.level_set.values(x) - targets) < 0
        watched[rows[lost]] = True
        return Drawn(x[lost], targets[lost], share=float(lost.sum()) / max(len(points), 1))

    return draw


def _start(coarse: CoarseDistance) -> Start:
    """Return the coarse signed distance to a cloud, zero where it is too near to be known."""

    def start(x: Tensor) -> Tensor:
        known, signed, *_ = coarse.at(x.numpy())
        values = np.zeros(len(x))
        values[known] = signed
        return torch.as_tensor(values)

    return start
