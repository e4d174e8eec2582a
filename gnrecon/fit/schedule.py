"""Samples in, a fitted signed distance field out.

The loss, in the paper's Monte Carlo form (weights on mean squares, unit coordinates, h the spacing of the data):

    interface   f = 0                  at the points        1
    normal      grad f = n             at the points        max(0.4 h, 0.012)^2, an angle as a height over that length
    distance    f = coarse distance    in the box           max(1e-4 M / N, 4e-4), M samples and N points
    eikonal     |grad f| = 1           near the surface     (0.05 h)^2
                                       and in the box

One wide layer is started by a linear solve and refined by Gauss-Newton steps in random subspaces: all output weights
and the frequencies of some hundreds of units, drawn afresh each step, so that J^T J stays small. Deeper networks are
fitted in all parameters along undamped directions, the data's weight rising in stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gnrecon.cloud import Samples
from gnrecon.errors import FitError
from gnrecon.field.siren import Siren
from gnrecon.fit.options import NORMAL_RESIDUALS, FitOptions
from gnrecon.fit.problem import FieldProblem
from gnrecon.fit.scene import Scene
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.fit.start import smooth_start, wide_start
from gnrecon.fit.terms import Term
from gnrecon.optim.gauss_newton import GaussNewton, StopRule
from gnrecon.optim.search import GainRatioDamping, LogLineSearch, Search
from gnrecon.optim.solution import Callback, Solution
from gnrecon.residuals.first_order import eikonal, interface, signed_distance
from gnrecon.sampling import near_surface

NORMAL_REACH, LEAST_REACH = 0.4, 0.012
EIKONAL_REACH = 0.05
DISTANCE_ROW, DISTANCE_WEIGHT = 1e-4, 4e-4
SUBSPACE_UNITS = 400
EIKONAL_COUNT = 3000
MAX_STEP_POINTS = 4000
DEEP_STAGES = ((0.25, 1.0), (0.5, 30.0), (1.0, 1000.0))
"""Up to this share of the steps, the interface's weight is this."""


def fit(
    samples: Samples, options: FitOptions | None = None, callback: Callback | None = None
) -> tuple[NeuralSDF, Solution]:
    """Fit a sine network to the signed distance of oriented points.

    An interrupt (Ctrl-C) during the steps keeps the best field so far; `Solution.interrupted` then says so.

    Parameters
    ----------
    samples : points and normals of shape (N, 3) in the unit ball, with their frame
    options : choices of network, start and steps
    callback : called with the record of each step

    Raises
    ------
    FitError
        When the field is not finite.
    """
    options = options or FitOptions()
    rng = np.random.default_rng(options.seed)
    scene = Scene.of(samples, options.device, rng)
    field = Siren(options.widths_for(len(samples)))
    fitted = (_fit_wide if len(field.widths) == 1 else _fit_deep)(field, scene, options, rng, callback)
    if not bool(torch.isfinite(fitted.theta).all()):
        raise FitError("The fit ended in parameters that are not finite; fewer steps (--steps) may help.")
    sdf = NeuralSDF(field, fitted.theta, samples.frame, scene.box, options.as_dict())
    return sdf, fitted


def _fit_wide(
    field: Siren, scene: Scene, options: FitOptions, rng: np.random.Generator, callback: Callback | None
) -> Solution:
    theta = wide_start(field, scene, lambda x, d, n: _start_terms(scene, options, rng, x, d, n), rng)
    search: Search = LogLineSearch() if options.search == "line" else GainRatioDamping(initial_damping=1.0)

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        del number
        units = torch.as_tensor(np.sort(rng.permutation(field.widths[0])[:SUBSPACE_UNITS])).to(theta.device)
        return FieldProblem(field, _step_terms(scene, options, rng, 1.0), theta, (units, None))

    return GaussNewton(search).run(problem_at, theta, StopRule(options.steps_for(len(scene.points))), callback)


def _fit_deep(
    field: Siren, scene: Scene, options: FitOptions, rng: np.random.Generator, callback: Callback | None
) -> Solution:
    theta = smooth_start(field, scene, lambda x, d, _: [_distance_term(scene, x, d)], rng)
    steps = options.steps_for(len(scene.points))
    search: Search = GainRatioDamping() if options.search == "damping" else LogLineSearch()

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        weight = next(weight for share, weight in DEEP_STAGES if number <= share * steps)
        return FieldProblem(field, _step_terms(scene, options, rng, weight), theta)

    # No stage may end early, because each one looks converged before the next raises the weight of the data.
    return GaussNewton(search).run(problem_at, theta, StopRule(steps, tolerance=0.0, patience=steps + 1), callback)


def _start_terms(
    scene: Scene, options: FitOptions, rng: np.random.Generator, x: Tensor, distance: Tensor, most: int
) -> list[Term]:
    # The start is a linear solve, and the cosine is not linear in f.
    linear = replace(options, normals="vector") if options.normals == "cosine" else options
    return [*_data_terms(scene, linear, rng, most), _distance_term(scene, x, distance)]


def _data_terms(scene: Scene, options: FitOptions, rng: np.random.Generator, most: int) -> list[Term]:
    """Interface and normals at the data points, or at `most` of them drawn afresh."""
    points, normals = scene.points, scene.normals
    if len(points) > most:
        rows = torch.as_tensor(np.sort(rng.permutation(len(points))[:most])).to(points.device)
        points, normals = points[rows], normals[rows]
    normal_weight = max(NORMAL_REACH * scene.coarse.spacing, LEAST_REACH) ** 2
    return [
        Term("interface", interface, points),
        Term("normal", NORMAL_RESIDUALS[options.normals], points, normals, normal_weight),
    ]


def _distance_term(scene: Scene, x: Tensor, distance: Tensor) -> Term:
    """The sparser the data, the more the free space must be told; the denser, the steeper a fit can turn in it."""
    weight = max(DISTANCE_ROW * len(x) / len(scene.points), DISTANCE_WEIGHT)
    return Term("distance", signed_distance, x, distance, weight)


def _step_terms(scene: Scene, options: FitOptions, rng: np.random.Generator, data_weight: float) -> Sequence[Term]:
    """Draw the terms of one step afresh."""
    x, distance = scene.volume(scene.volume_count, rng)
    spacing = scene.coarse.spacing
    near = near_surface(scene.samples.points, 2 * spacing, EIKONAL_COUNT, rng)
    around = np.concatenate([near, scene.box.sample(EIKONAL_COUNT // 3, rng)])
    eikonal_weight = (EIKONAL_REACH * spacing) ** 2
    return [
        *(
            replace(term, weight=term.weight * data_weight)
            for term in _data_terms(scene, options, rng, MAX_STEP_POINTS)
        ),
        _distance_term(scene, scene.tensor(x), scene.tensor(distance)),
        Term("eikonal", eikonal, scene.tensor(around), None, eikonal_weight * data_weight**0.5),
    ]
