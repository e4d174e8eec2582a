"""Fits of one sine network: of one wide layer (`fit_wide`) or of several layers (`fit_deep`).

*Several layers.* The start decides the result. From small weights the network is nearly linear, and Gauss-Newton spends
50 to 90 steps on a plateau (the paper's start); from random frequencies and an exact solve of the last layer
(`initialisation.spectral_start`) it has none. The stages (`continuation_stages`) then raise the number of rows (a step
far from the minimum needs only part of the data), the weight of the data against the volume, and the precision of J:
single precision suffices while the damping is well above its rounding. Of 1,000 points or more, one in twenty is held
out; the fit ends when the residuals there stop falling, and returns the parameters for which they were least.

*One wide layer.* See the comment on `fit_wide`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.initialisation import Spectrum, spectral_start, wide_start
from gnrecon.fit.objective import FieldProblem, Scene, data_terms, linear_data_terms, start_terms, step_terms
from gnrecon.fit.parameters import SingleNetworkParameters
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
from gnrecon.optim.problem import loss_of
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


@dataclass(frozen=True)
class Stage:
    """A part of the steps.

    Parameters
    ----------
    until : share of the steps at which it ends
    rows : most data points of a step
    data_weight : of interface and normals
    precision : of the Jacobian's factors
    """

    until: float
    rows: int
    data_weight: float
    precision: torch.dtype


def continuation_stages() -> tuple[Stage, ...]:
    """Return the stages of a deep fit, measured in docs/research."""
    return (
        Stage(0.1, 2000, 1.0, torch.float32),
        Stage(0.3, 6000, 1.0, torch.float32),
        Stage(0.6, 15000, 30.0, torch.float32),
        Stage(1.0, 15000, 1000.0, torch.float64),
    )


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
    theta = spectral_start(field, fitted, partial(start_terms, fitted, options, rng), rng)
    advance(1.0)
    # Signing volume samples takes as long as a step, so that one pool serves for all of them.
    pool = tuple(scene.tensor(values) for values in fitted.volume(parameters.pool_samples, rng))

    stages = continuation_stages()

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        stage = next((stage for stage in stages if number <= stage.until * steps), stages[-1])
        rows = torch.as_tensor(np.sort(rng.permutation(len(pool[0]))[: min(stage.rows, scene.volume_count)]))
        x, distance = (values[rows.to(values.device)] for values in pool)
        terms = step_terms(fitted, options, rng, (x, distance), stage.rows, stage.data_weight)
        return FieldProblem(field, terms, theta, precision=stage.precision)

    optimiser = optimiser_for(options, GainRatioDamping(initial_damping=1e-2, metric=layer_scaled, geodesic=True))
    # No stage may end early, because each one looks converged before the next raises the weight of the data.
    stop = StopRule(steps, tolerance=0.0, patience=steps + 1, held_out_patience=parameters.held_out_patience_steps)
    check = None if held is None else _held_out_loss(field, held, options, rng)
    return optimiser.run(problem_at, theta, stop, callback, check)


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
    return _only(scene, fitted), _only(scene, held)


def _only(scene: Scene, rows: Tensor) -> Scene:
    return replace(scene, points=scene.points[rows], normals=scene.normals[rows])


def _held_out_loss(
    field: Siren, held: Scene, options: FitOptions, rng: np.random.Generator
) -> Callable[[Tensor], float]:
    """Return the loss of interface and normals at the held-out points, as a function of theta."""
    terms = data_terms(held, options, rng, len(held.points))

    def loss(theta: Tensor) -> float:
        return loss_of(FieldProblem(field, terms, theta), theta)

    return loss


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
        "geodesic": GainRatioDamping(initial_damping=1e-2, metric=layer_scaled, geodesic=True),
        "line": LogLineSearch(),
    }
    return GaussNewton(searches[options.search], SOLVERS[options.solver](krylov_tolerance))


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
