"""One wide layer: a linear start, then steps in random subspaces.

A step frees all output weights and the frequencies of some hundreds of units, drawn afresh each time, so that J^T J
stays small. Adam and L-BFGS, which need no J^T J, free all parameters.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.loss import start_terms, step_terms
from gnrecon.fit.method import optimiser_for
from gnrecon.fit.options import FitOptions
from gnrecon.fit.problem import FieldProblem
from gnrecon.fit.scene import Scene
from gnrecon.fit.start import COARSE, Spectrum, wide_start
from gnrecon.optim import Callback, GainRatioDamping, Solution, StopRule
from gnrecon.runtime.progress import Advance, unheard

SUBSPACE_UNITS = 400
MAX_STEP_POINTS = 4000


def fit_wide(
    field: Siren,
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    callback: Callback | None,
    advance: Advance = unheard,
    spectrum: Spectrum = COARSE,
) -> Solution:
    """Fit a network of one hidden layer; `advance` is told of the share of the start that is done."""
    theta = wide_start(field, scene, lambda x, d, n: start_terms(scene, options, rng, x, d, n), rng, spectrum, advance)
    whole = options.optimiser != "gn"

    def problem_at(number: int, theta: Tensor) -> FieldProblem:
        del number
        units = torch.as_tensor(np.sort(rng.permutation(field.widths[0])[:SUBSPACE_UNITS])).to(theta.device)
        x, distance = (scene.tensor(values) for values in scene.volume(scene.volume_count, rng))
        terms = step_terms(scene, options, rng, (x, distance), MAX_STEP_POINTS)
        return FieldProblem(field, terms, theta, None if whole else (units, None))

    optimiser = optimiser_for(options, GainRatioDamping(initial_damping=1.0))
    return optimiser.run(problem_at, theta, StopRule(options.steps_for(len(scene.points))), callback)
