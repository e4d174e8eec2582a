"""gnrecon's fit of the paper's network to the paper's loss, used to measure the times to a given loss.

Start (`solved_start`): random sine features, whose last layer is solved for. The first layer's frequencies are normal,
its phases uniform; the inner layers' weights are uniform within sqrt(6 / fan-in), their phases within pi. The last
layer fits  f = 0,  grad f = n  and coarse signed distances in the volume by least squares with a ridge.

Fit (`our_fit`): Levenberg-Marquardt with geodesic acceleration in the layer-scaled metric. The first steps use few
points, drawn afresh, and each step uses more of them, until all are used.

Both sides are compared in the two data means of the loss. The third, the eikonal constraint, works against them: at its
full weight the rocker arm's fit ends in a minimum whose data loss is 2.8e-4. Its weight therefore falls by a constant
factor per step to a hundredth of the paper's, as the paper lets it fall to zero for its minimal surfaces. The benchmark
also measures the fit at the full weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from benchmarks.engine.paper_loss import PAPER_WEIGHTS, LossWeights, Sample, posed, surrounded
from benchmarks.harness.measurement import Clock
from gnrecon.field import Siren
from gnrecon.fit.initialisation import solve_last_layer
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm, Scene
from gnrecon.fit.parameters import SingleNetworkParameters
from gnrecon.fit.single_network import geodesic_search
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.least_squares import SOLVERS
from gnrecon.optim import GaussNewton, StopRule
from gnrecon.residuals import interface, normal_vector, signed_distance
from gnrecon.runtime.parallel import fixed_sums

OnRecord = Callable[[float, Tensor], None]
"""Called with the seconds so far, without its own, and theta, of shape (p,)."""


def our_fit(
    points: Tensor,
    normals: Tensor,
    seconds: float,
    on_record: OnRecord,
    eikonal_falls: bool = True,
    *,
    widths: tuple[int, ...],
    first_points: int = 1500,
    growth: float = 1.25,
    last_growth_step: int = 50,
    initial_damping: float = 1e-2,
) -> None:
    """Fit a network to points and unit normals, of shape (N, 3), for so many seconds.

    An exception of `on_record` ends the fit.

    Parameters
    ----------
    eikonal_falls : whether the eikonal weight falls; otherwise the weights are the paper's throughout
    widths : of the network
    first_points, growth, last_growth_step : points of the first step, their factor per step, and the last step with it
    initial_damping : of Levenberg-Marquardt
    """
    clock, generator = Clock(), torch.Generator().manual_seed(0)
    field = Siren(widths)
    sample = surrounded(points, normals, seed=0)

    def report(theta: Tensor) -> None:
        now = clock.seconds
        with clock.pause():
            on_record(now, theta)

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        report(theta)
        count = int(first_points * growth ** min(number - 1, last_growth_step))
        weights = weights_at(number) if eikonal_falls else PAPER_WEIGHTS
        return posed(field, theta, drawn(sample, count, generator), torch.float32, weights=weights)

    start = solved_start(field, sample)
    solver = SOLVERS["auto"](SingleNetworkParameters.krylov_tolerance)
    search = replace(geodesic_search(), initial_damping=initial_damping)
    steps = 1_000_000
    stop = StopRule(steps, tolerance=0.0, patience=steps, seconds=seconds - clock.seconds)
    with fixed_sums(None):
        solution = GaussNewton(search, solver).run(problem_at, start, stop)
    report(solution.theta)


def weights_at(number: int, *, eikonal_factor: float = 0.7, least_eikonal: float = 1e-2) -> LossWeights:
    """Return the weights in step `number`.

    The eikonal weight is multiplied by `eikonal_factor` each step, down to the share `least_eikonal` of the paper's.
    """
    return PAPER_WEIGHTS._replace(eikonal=PAPER_WEIGHTS.eikonal * max(eikonal_factor**number, least_eikonal))


def drawn(sample: Sample, count: int, generator: torch.Generator, *, least_volume: int = 300) -> Sample:
    """Return `count` points of a sample and half as many of its volume, or the whole sample if it is not larger."""
    if count >= len(sample.points):
        return sample
    rows = torch.randperm(len(sample.points), generator=generator)[:count]
    volume = torch.randperm(len(sample.volume), generator=generator)[: max(count // 2, least_volume)]
    return Sample(sample.points[rows], sample.normals[rows], sample.volume[volume])


def sine_features(field: Siren, seed: int, *, frequency: float = 6.0) -> Tensor:
    """Return theta, of shape (p,), whose last layer is zero.

    `frequency` is the standard deviation of the first layer's frequencies.
    """
    generator = torch.Generator().manual_seed(seed)
    layers = []
    for level, (out, into) in enumerate(field.layout.shapes):
        phases = math.pi * uniform(out, 1, generator)[:, 0]
        weights = math.sqrt(6.0 / into) * uniform(out, into, generator)
        if level == 0:
            weights = frequency * torch.randn(out, into, generator=generator, dtype=torch.float64)
        layers.append((weights, phases))
    layers[-1] = (torch.zeros_like(layers[-1][0]), torch.zeros_like(layers[-1][1]))
    return field.layout.flatten(layers)


def uniform(rows: int, columns: int, generator: torch.Generator) -> Tensor:
    """Return numbers within -1 and 1, of shape (rows, columns)."""
    return 2 * torch.rand(rows, columns, generator=generator, dtype=torch.float64) - 1


def solved_start(
    field: Siren,
    sample: Sample,
    seed: int = 0,
    *,
    most_points: int = 3000,
    ridge: float = 1e-4,
    normal_weight: float = 0.1,
    distance_weight: float = 0.1,
) -> Tensor:
    """Return theta, of shape (p,), whose last layer fits at most `most_points` of the sample."""
    rng = np.random.default_rng(seed)
    points, normals = sample.points.cpu().numpy(), sample.normals.cpu().numpy()
    scene = Scene.of(Samples(points, normals, Frame(np.zeros(3), 1.0)), "cpu", rng)
    x, distance = scene.volume(most_points, rng)
    chosen = torch.as_tensor(rng.permutation(len(points))[:most_points])
    on = scene.points[chosen]
    terms = [
        ObjectiveTerm("data", interface, on),
        ObjectiveTerm("normal", normal_vector, on, scene.normals[chosen], normal_weight),
        ObjectiveTerm("distance", signed_distance, scene.tensor(x), scene.tensor(distance), distance_weight),
    ]
    return solve_last_layer(field, terms, sine_features(field, seed), ridge).to(sample.points)
