"""The paper's reconstruction of a scan as a problem of shape learning, for comparing optimisers.

The terms are f = 0 and n . grad f = 1 at the points, both with weight one, and the eikonal constraint in the box around
them; the network has 3 x 32 sine units. The eikonal weight falls from the paper's 1e-2 to a hundredth of that within
about thirteen steps, because it competes with the data. If points and normals alone determine the network it is then
dropped, because each step would overfit its own points of the box. The reported loss is that of points and normals, as
in the paper. One term is not the paper's: away from the points, where their winding number gives the sign, the field
must keep it. Without it, steps as long as these leave sheets in the free space, which neither the loss nor the points
detect. The paper starts with a sphere; here the start is the coarse signed distance of the cloud
(`geometry.signed_distance.CoarseDistance`), with features of several wavelengths, so that there is no plateau.

To reconstruct a scan use `gnrecon.reconstruct`, which is more accurate. All numbers are in `ScanParameters`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.field import Network
from gnrecon.field.layers import SINE
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Box, CoarseDistance, free_space_bounds, kd_tree_order
from gnrecon.least_squares import Iterative, LinearSolver, NeighbourSums, Preconditioner, jacobian_layer_scaled
from gnrecon.level_set import LevelSet
from gnrecon.optim import GainRatioDamping
from gnrecon.residuals import eikonal, free_space, interface, normal_projection
from gnrecon.shape_learning.learning_parameters import ScanParameters, ShapeLearningParameters
from gnrecon.shape_learning.shape_problem import (
    SampledPoints,
    Sampler,
    ShapeProblem,
    Start,
    StepState,
    Term,
    Weight,
    at_points,
    fading,
    falling,
    growing,
    in_box,
)


@dataclass(frozen=True)
class ScannedSurface:
    """A surface known by points, to compare a level set with.

    Parameters
    ----------
    points : of shape (N, 3)
    """

    points: Tensor

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Return about `count` of the points, of shape (M, 3), and their equal shares of the area, of shape (M,)."""
        chosen = self.points[:: -(-len(self.points) // count)]
        return chosen, torch.full_like(chosen[:, 0], 1 / len(chosen))

    def nearest(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest points, of shape (N, 3), to queries, (N, 3), and that all are in the patch, (N,)."""
        rows = cKDTree(self.points.numpy()).query(queries.numpy())[1]
        return self.points[torch.as_tensor(rows)], torch.ones(len(queries), dtype=torch.bool)


def scanned(
    samples: Samples,
    all_points: Samples | None = None,
    name: str = "scan",
    seed: int = 0,
    *,
    parameters: ScanParameters = ShapeLearningParameters.scan,
) -> ShapeProblem:
    """Return the problem of a surface through points with normals.

    Parameters
    ----------
    samples : points to learn from, in the unit ball
    all_points : points to measure the error with, in the same frame, by default `samples`
    name : of the problem
    seed : of the coarse distance and the free space
    parameters : weights, points and distances
    """
    order = kd_tree_order(samples.points)
    samples = samples.select(order)
    box = Box.around(samples.points, parameters.box_margin_radii)
    network = Network(parameters.widths, SINE, (parameters.first_layer_frequency,))
    # A point with a normal has two residuals.
    determined = 2 * len(samples) >= parameters.determined_rows_per_parameter * network.layout.count
    coarse = CoarseDistance(samples.points, samples.normals, np.random.default_rng(seed))
    count = growing(
        parameters.first_points, parameters.point_growth, parameters.many_points, parameters.slow_point_growth
    )
    free = _free_space(samples, coarse, box, determined, np.random.default_rng(seed), parameters)
    terms = (
        Term("interface", interface, at_points(samples.points, count=count)),
        Term("normal", normal_projection, at_points(samples.points, samples.normals, count=count)),
        Term("eikonal", eikonal, in_box(parameters.box_points), _eikonal_weight(determined, parameters), 0.0),
        Term("free space", free_space, free, parameters.free_space_weight, 0.0),
    )
    known = ScannedSurface(torch.as_tensor((all_points or samples).points))
    search = GainRatioDamping(initial_damping=1e-2, metric=jacobian_layer_scaled, geodesic=True)
    return ShapeProblem(
        name,
        terms,
        box,
        _start(coarse),
        network,
        known,
        search=search,
        solver=short_run_cg,
        stored=torch.float32,
    )


def short_run_cg(*, longest: int = 4, energy: float = 0.03) -> LinearSolver:
    """Return conjugate gradients preconditioned by sums of few neighbouring rows, set up again at each step.

    The wavelengths of the network are short, and the dampings small. For the rocker arm's rows after forty steps, runs
    of four take 10 iterations and a quarter of the cost of J^T J, runs of eight 33 iterations, runs of two 4. Later
    runs of two are cheaper than runs of four, and in the end J^T J itself is cheaper than both.

    Parameters
    ----------
    longest : rows of a run
    energy : relative error of a step in the norm of the damped matrix. With 0.1 there are more steps in the same time,
        but the final loss is higher
    """
    return Iterative("cg", NeighbourSums(longest=longest), energy=energy, reuse=False, adapt=_RunHalving())


@dataclass
class _RunHalving:
    """Halves the runs, down to single rows, when steps take many iterations.

    Parameters
    ----------
    most_iterations : mean number of iterations per step above which runs are halved
    steps_between : steps before runs can be halved again, so that the mean shows the effect
    """

    most_iterations: float = 40.0
    steps_between: int = 8
    waited: int = field(default=0, init=False)

    def __call__(self, preconditioner: Preconditioner, iterations: float) -> Preconditioner:
        """Return the preconditioner of the next step, by the mean number of iterations of the last steps."""
        self.waited += 1
        few = iterations <= self.most_iterations or self.waited < self.steps_between
        if not isinstance(preconditioner, NeighbourSums) or few:
            return preconditioner
        self.waited = 0
        return replace(preconditioner, longest=max(preconditioner.longest // 2, 1))


def _eikonal_weight(determined: bool, parameters: ScanParameters) -> Weight:
    """Return the weight at each step; it ends at zero if points and normals determine the network."""
    first, factor, least = parameters.eikonal_weight, parameters.eikonal_factor, parameters.least_eikonal_weight
    return fading(first, 0, factor, least) if determined else falling(first, factor, least)


def _free_space(
    samples: Samples,
    coarse: CoarseDistance,
    box: Box,
    determined: bool,
    rng: np.random.Generator,
    parameters: ScanParameters,
) -> Sampler:
    """Return a sampler of points where the field has the wrong sign, until the free space is dropped.

    Points that had the wrong sign once are tested in every later step, so that successive steps have the same terms.
    """
    near = torch.as_tensor(samples.points[:: -(-len(samples) // parameters.settled_points)])
    last_step = parameters.free_space_steps if determined else ShapeLearningParameters.measurement_step
    pool = box.sample(parameters.free_space_pool_points, rng)
    known, signed, distance, _ = coarse.at(pool, parameters.clear_disks)
    clear = distance > parameters.clear_distance_radii
    points = torch.as_tensor(pool[known][clear])
    least = torch.as_tensor(free_space_bounds(signed[clear], parameters.deepest_value_radii))
    watched = torch.zeros(len(points), dtype=torch.bool)

    def settled(level_set: LevelSet) -> bool:
        return float(level_set.values(near).square().mean()) < parameters.settled_distance_radii**2

    def draw(state: StepState) -> SampledPoints:
        if state.step == 1:  # a new run of the same problem
            watched.zero_()
        if state.step > last_step and settled(state.level_set):
            return SampledPoints(points[:0], least[:0], share=0.0)
        # For a cloud of few points there may be no point of the box with a known sign.
        drawn = state.rng.integers(len(points), size=parameters.free_space_points if len(points) else 0)
        rows = watched.index_fill(0, torch.as_tensor(drawn), True).nonzero()[:, 0]
        x, targets = points[rows], least[rows]
        wrong = targets.sign() * (state.level_set.values(x) - targets) < 0
        watched[rows[wrong]] = True
        return SampledPoints(x[wrong], targets[wrong], share=float(wrong.sum()) / max(len(points), 1))

    return draw


def _start(coarse: CoarseDistance) -> Start:
    """Return the coarse signed distance to a cloud, and zero where it is unknown because the cloud is too near."""

    def start(x: Tensor) -> Tensor:
        known, signed, *_ = coarse.at(x.numpy())
        values = np.zeros(len(x))
        values[known] = signed
        return torch.as_tensor(values)

    return start
