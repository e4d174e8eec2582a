"""Our fit of the paper's network to its loss, as the times to a quality are measured of it.

From random sine features whose last layer is solved for, Levenberg-Marquardt with geodesic acceleration in the
layer-scaled metric. The first steps see few points, drawn afresh, and each step more of them than the one before, until
all are used.

Two means of the loss are of the data, and are what both sides are compared in; the third, the eikonal constraint,
stands against them: at its full weight the rocker arm's fit ends in a minimum whose data loss is 2.8e-4. Its weight
therefore falls by a constant factor each step to a hundredth of the paper's, as the paper lets it fall to zero for its
minimal surfaces. A benchmark that measures the same at the full weight shows the difference.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.engine.clock import Clock
from benchmarks.engine.loss import WEIGHTS, Sample, posed
from benchmarks.engine.scans import VOLUME_COUNT, surrounded
from benchmarks.engine.start import solved_start
from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem
from gnrecon.fit.parameters import SingleNetworkParameters
from gnrecon.least_squares import SOLVERS, layer_scaled
from gnrecon.optim import GainRatioDamping, GaussNewton, StopRule

WIDTHS = (32, 32, 32)

FIRST_POINTS, GROWTH, LAST_STAGE, LEAST_VOLUME = 1500, 1.25, 50, 300
DAMPING = 1e-2

EIKONAL_FALL, LEAST_EIKONAL = 0.7, 1e-2
"""By which the eikonal weight falls each step, and the share of the paper's at which it stays."""

OnRecord = Callable[[float, Tensor], None]
"""Called with the seconds so far, its own not counted, and theta, of shape (p,)."""


def ours(points: Tensor, normals: Tensor, seconds: float, on_record: OnRecord, eikonal_falls: bool = True) -> None:
    """Fit a network of WIDTHS to points and unit normals, of shape (N, 3), for so many seconds.

    Whatever `on_record` raises ends the fit. With the paper's weights throughout where the eikonal one does not fall.
    """
    clock, generator = Clock(), torch.Generator().manual_seed(0)
    field = Siren(WIDTHS)
    sample = surrounded(points, normals, VOLUME_COUNT, seed=0)

    def report(theta: Tensor) -> None:
        now = clock.seconds
        with clock.pause():
            on_record(now, theta)

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        report(theta)
        count = int(FIRST_POINTS * GROWTH ** min(number - 1, LAST_STAGE))
        weights = weights_at(number) if eikonal_falls else WEIGHTS
        return posed(field, theta, drawn(sample, count, generator), torch.float32, weights=weights)

    start = solved_start(field, sample)
    solver = SOLVERS["auto"](SingleNetworkParameters.krylov_tolerance)
    search = GainRatioDamping(initial_damping=DAMPING, metric=layer_scaled, geodesic=True)
    steps = 1_000_000
    stop = StopRule(steps, tolerance=0.0, patience=steps, seconds=seconds - clock.seconds)
    report(GaussNewton(search, solver).run(problem_at, start, stop).theta)


def weights_at(number: int) -> tuple[float, float, float]:
    """Return the weights of the data, the normals and the eikonal constraint in step `number`."""
    data, normal, volume = WEIGHTS
    return data, normal, volume * max(EIKONAL_FALL**number, LEAST_EIKONAL)


def drawn(sample: Sample, count: int, generator: torch.Generator) -> Sample:
    """Return `count` points of a sample and half as many of its volume, or all where there are no more."""
    if count >= len(sample.points):
        return sample
    rows = torch.randperm(len(sample.points), generator=generator)[:count]
    volume = torch.randperm(len(sample.volume), generator=generator)[: max(count // 2, LEAST_VOLUME)]
    return Sample(sample.points[rows], sample.normals[rows], sample.volume[volume])
