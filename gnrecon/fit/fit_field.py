"""Fits a signed distance field to oriented points.

`fit` is the entry. By default it fits a smooth global field and local fields (`two_level`), which the data determines
without settings. With a network, a number of steps, another optimiser or another normal residual in the options, it
fits one network instead (`single_network`): a linear start (`initialisation`), then steps of an optimiser
(`gnrecon.optim`) on the terms of `objective`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gnrecon.field.networks import Siren
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.objective import Scene
from gnrecon.fit.parameters import FitParameters, SingleNetworkParameters
from gnrecon.fit.shape_priors.ball_fit import BallFit
from gnrecon.fit.shape_priors.convex_completion import completed_convex
from gnrecon.fit.shape_priors.sharp_shape import SharpShape
from gnrecon.fit.single_network import fit_deep, fit_wide
from gnrecon.fit.two_level import fit_two_level
from gnrecon.geometry.point_cloud import Samples
from gnrecon.optim import Callback, Record, Solution
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.runtime.parallel import fixed_sums
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange


@fixed_sums(None)
def fit(
    samples: Samples,
    options: FitOptions | None = None,
    callback: Callback | None = None,
    advance: ProgressCallback = ignore_progress,
    folder: str | Path | None = None,
    scheduler: str | None = None,
    *,
    parameters: FitParameters = FitParameters(),
) -> tuple[NeuralSDF, Solution]:
    """Fit a sine network to the signed distance of oriented points.

    The field does not depend on the number of threads. An interrupt (Ctrl-C) during the steps keeps the best field so
    far; `Solution.interrupted` then says so.

    Parameters
    ----------
    samples : points and normals of shape (N, 3) in the unit ball, with their frame
    options : choices of network, start and steps
    callback : called with the record of each step
    advance : called with the share that is done
    folder : work folder of the default fit, which is then solved by blocks and resumes from what the folder holds
    scheduler : address of a Dask scheduler whose workers see the folder and solve the blocks
    parameters : tuning constants of the default fit

    Raises
    ------
    UsageError
        When a folder is given for one network, or holds anything but this fit's work, or no scheduler answers.
    FitError
        When the field is not finite.
    """
    options = options or FitOptions()
    rng = np.random.default_rng(options.seed)
    convex = _completed(samples, parameters) if options.adaptive else None
    given, samples = samples, convex or samples
    if options.adaptive:
        sdf, fitted = fit_two_level(samples, options, rng, advance, folder, scheduler, callback, parameters=parameters)
    elif folder is not None:
        raise UsageError("A work folder is for the default fit only; leave out --widths and --steps.")
    else:
        sdf, fitted = _fit_network(samples, options, rng, callback, advance)
    if not sdf.finite:
        raise FitError("The fit ended in parameters that are not finite; fewer steps (--steps) may help.")
    if convex is not None:
        status = (
            f"{fitted.status} The {len(given)} points lie on a convex surface, which was filled smoothly with "
            f"{len(convex) - len(given)} samples."
        )
        fitted = replace(fitted, status=status)
    if options.adaptive and (options.solver, options.search) != (FitOptions.solver, FitOptions.search):
        unused = "The solver and the search of the options are those of one network alone, and were not used."
        fitted = replace(fitted, status=f"{fitted.status} {unused}")
    support = _support(given) if sdf.support is None else np.concatenate([_support(given), sdf.support])
    return replace(sdf, support=support), fitted


def _completed(samples: Samples, parameters: FitParameters) -> Samples | None:
    """Return few points on a convex surface with more between them; a ball and sharp faces have better priors."""
    found = completed_convex(samples)
    ball = found is not None and BallFit.of(samples, parameters.ball) is not None
    if found is None or ball or SharpShape.of(samples, parameters.shape_priors) is not None:
        return None
    return found


def _fit_network(
    samples: Samples,
    options: FitOptions,
    rng: np.random.Generator,
    callback: Callback | None,
    advance: ProgressCallback,
    *,
    parameters: SingleNetworkParameters = SingleNetworkParameters(),
) -> tuple[NeuralSDF, Solution]:
    """Fit the network that the options describe."""
    scene = Scene.of(samples, options.device, rng)
    field = Siren(options.widths_for(len(samples)))
    steps = options.steps_for(len(samples))
    wide = len(field.widths) == 1
    started = parameters.wide_start_time_share if wide else parameters.deep_start_time_share
    started = started if steps else 1.0

    def report(record: Record) -> None:
        if callback is not None:
            callback(record)
        advance(started + (1.0 - started) * record.step / steps)

    method = fit_wide if wide else fit_deep
    fitted = method(field, scene, options, rng, report, subrange(advance, 0.0, started))
    return NeuralSDF(field, fitted.theta, samples.frame, scene.box, options.as_dict()), fitted


def _support(samples: Samples, *, most_points: int = 20_000) -> npt.NDArray[np.float32]:
    """Return the points that are kept with the field, at most `most_points`, in their order, of shape (N, 3).

    Meshing tells with them where the surface is supported by data; 20,000 take 240 kB.
    """
    rows = np.arange(len(samples))
    if len(rows) > most_points:
        # At random, because a scanner's order has patterns, with a generator of its own: the fit's draws stay the same.
        rows = np.sort(np.random.default_rng(0).choice(rows, most_points, replace=False))
    return samples.points[rows].astype(np.float32)
