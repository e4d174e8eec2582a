"""Fits of one sine network: of one wide layer (`fit_wide`) or of several layers (`fit_deep`).

*Several layers.* The start decides the result. From small weights the network is nearly linear, and Gauss-Newton spends
50 to 90 steps on a plateau (the paper's start); from random frequencies and an exact solve of the last layer
(`initialisation.spectral_start`) it has none. The rows are those of the default fit's network (`global_network`), each
over the deviation that left-out points have from the field, so that the weight of the data rises as the field gets
nearer. The first steps use few points, drawn afresh, and each one more. Of 1,000 points or more, one in twenty is left
out, and the fit ends when their score stops falling. The parameters of the least score are returned.

*One wide layer.* See the comment on `fit_wide`.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.fit_options import FitOptions, normal_residual
from gnrecon.fit.global_network import NetworkTerms
from gnrecon.fit.initialisation import Spectrum, spectral_start, wide_start
from gnrecon.fit.objective import FieldProblem, Scene, linear_data_terms, start_terms, step_terms
from gnrecon.fit.parameters import NetworkTermParameters, SingleNetworkParameters
from gnrecon.least_squares import SOLVERS, layer_scaled
from gnrecon.optim import (
    LBFGS,
    Adam,
    Callback,
    GainRatioDamping,
    GaussNewton,
    LogLineSearch,
    Optimiser,
    Search,
    Solution,
    StopRule,
)
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


def fit_deep(
    field: Siren,
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    callback: Callback | None,
    advance: ProgressCallback = ignore_progress,
    *,
    parameters: SingleNetworkParameters = SingleNetworkParameters(),
) -> Solution:
    """Fit a network of several hidden layers; `advance` is called when the start is solved."""
    steps = options.steps_for(len(scene.points))
    fitted, held = hold_out(scene, rng, parameters=parameters)
    checked = fitted if held is None else held
    validation = checked.points.cpu().numpy(), checked.normals.cpu().numpy()
    least = field.layout.count // parameters.parameters_per_point
    rows = NetworkTermParameters(
        data_rows=max(NetworkTermParameters.data_rows, least),
        near_eikonal_deviation=parameters.near_eikonal_deviation,
        far_eikonal_deviation=parameters.far_eikonal_deviation,
    )
    terms = NetworkTerms.draw(fitted, *validation, rng, normal=normal_residual(options.normals), parameters=rows)
    theta = spectral_start(field, fitted, partial(start_terms, fitted, options, rng), rng)
    advance(1.0)
    noise = terms.noise(field, theta)

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        nonlocal noise
        noise = noise.followed(terms.noise(field, theta))
        # In logarithms, as the power of thousands of steps is no number.
        growing = math.exp(min((number - 1) * math.log(parameters.points_growth), math.log(rows.data_rows)))
        few = terms.with_rows(max(least, int(parameters.first_points * growing)))
        return few.problem(field, theta, noise, rng)

    optimiser = optimiser_for(options, geodesic_search())
    # The score of points that are fitted shows which parameters are best, but not when they begin to follow noise.
    patience = steps + 1 if held is None else parameters.held_out_patience_steps
    stop = StopRule(steps, parameters.least_gain, steps + 1, held_out_patience=patience)
    return optimiser.run(problem_at, theta, stop, callback, partial(terms.score, field))


def hold_out(
    scene: Scene,
    rng: np.random.Generator,
    *,
    parameters: SingleNetworkParameters = SingleNetworkParameters(),
) -> tuple[Scene, Scene | None]:
    """Return the scene with the points to fit, and that with those to check on, or None where there are too few."""
    count = len(scene.points)
    if count < parameters.least_points_to_hold_out:
        return scene, None
    order = torch.as_tensor(rng.permutation(count)).to(scene.points.device)
    held, fitted = (rows.sort().values for rows in order.tensor_split([count // parameters.held_out_one_in]))
    return scene.take(fitted), scene.take(held)


# From the options' names to an optimiser.


def optimiser_for(
    options: FitOptions, auto: Search, *, krylov_tolerance: float = SingleNetworkParameters.krylov_tolerance
) -> Optimiser:
    """Return the optimiser that the options name; `auto` is the search that suits the network's start."""
    if options.optimiser == "adam":
        return Adam()
    if options.optimiser == "lbfgs":
        return LBFGS()
    searches: dict[str, Search] = {
        "auto": auto,
        "damping": GainRatioDamping(initial_damping=auto.initial_damping, metric=auto.metric),
        "geodesic": geodesic_search(),
        "line": LogLineSearch(),
    }
    return GaussNewton(searches[options.search], SOLVERS[options.solver](krylov_tolerance))


def geodesic_search(*, least_share: float = SingleNetworkParameters.least_step_share) -> GainRatioDamping:
    """Return the search of deep networks."""
    return GainRatioDamping(initial_damping=1e-2, metric=layer_scaled, geodesic=True, least_share=least_share)


# One wide layer: a linear start, then steps in random subspaces.
#
# A step frees all output weights and the frequencies of some hundreds of units, drawn afresh each time, so that J^T J
# stays small. Adam and L-BFGS, which need no J^T J, free all parameters.


def fit_wide(
    field: Siren,
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    callback: Callback | None,
    advance: ProgressCallback = ignore_progress,
    spectrum: Spectrum = Spectrum(),
    *,
    parameters: SingleNetworkParameters = SingleNetworkParameters(),
) -> Solution:
    """Fit a network of one hidden layer; `advance` is called with the share of the start that is done."""
    data = linear_data_terms(scene, options, rng, parameters.start_points)
    theta = wide_start(field, scene, data, rng, spectrum, advance)
    whole = options.optimiser != "gn"

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        del number
        units = torch.as_tensor(np.sort(rng.permutation(field.widths[0])[: parameters.subspace_units])).to(theta.device)
        x, distance = (scene.tensor(values) for values in scene.volume(scene.volume_count, rng))
        terms = step_terms(scene, options, rng, (x, distance), parameters.step_points)
        return FieldProblem(field, terms, theta, None if whole else (units, None))

    optimiser = optimiser_for(options, GainRatioDamping(initial_damping=1.0))
    return optimiser.run(problem_at, theta, StopRule(options.steps_for(len(scene.points))), callback)
