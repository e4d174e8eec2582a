"""Samples in, a fitted signed distance field out: by default `adaptive`, else one wide layer or several, as asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gnrecon.field.networks import Siren
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.objective import Scene
from gnrecon.fit.single_network import fit_deep, fit_wide
from gnrecon.fit.two_level import fit_two_level
from gnrecon.geometry.point_cloud import Samples
from gnrecon.optim import Callback, Record, Solution
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, part

WIDE_STARTED, DEEP_STARTED = 0.4, 0.05
"""About which share of the time has passed when the start is made, where steps follow."""

MOST_SUPPORT = 20_000
"""Points that stay with a field, so that meshing it later can tell surface from what was invented."""


def fit(
    samples: Samples,
    options: FitOptions | None = None,
    callback: Callback | None = None,
    advance: ProgressCallback = ignore_progress,
    folder: str | Path | None = None,
    scheduler: str | None = None,
) -> tuple[NeuralSDF, Solution]:
    """Fit a sine network to the signed distance of oriented points.

    An interrupt (Ctrl-C) during the steps keeps the best field so far; `Solution.interrupted` then says so.

    Parameters
    ----------
    samples : points and normals of shape (N, 3) in the unit ball, with their frame
    options : choices of network, start and steps
    callback : called with the record of each step
    advance : told of the share that is done, of the start and of the most steps that may follow
    folder : where the work of the default fit is kept, solved by blocks then, so that the same fit takes it up again
    scheduler : address of a Dask scheduler whose workers see the folder and solve the blocks

    Raises
    ------
    UsageError
        When a folder is given for one network, or holds anything but this fit's work, or no scheduler answers.
    FitError
        When the field is not finite.
    """
    options = options or FitOptions()
    rng = np.random.default_rng(options.seed)
    if options.adaptive:
        sdf, fitted = fit_two_level(samples, options, rng, advance, folder, scheduler)
    elif folder is not None:
        raise UsageError("A work folder serves the default fit alone, not one network (--widths, --steps).")
    else:
        sdf, fitted = _fit_network(samples, options, rng, callback, advance)
    if not sdf.finite:
        raise FitError("The fit ended in parameters that are not finite; fewer steps (--steps) may help.")
    return replace(sdf, support=_support(samples)), fitted


def _fit_network(
    samples: Samples,
    options: FitOptions,
    rng: np.random.Generator,
    callback: Callback | None,
    advance: ProgressCallback,
) -> tuple[NeuralSDF, Solution]:
    """Fit the one network that the options ask for."""
    scene = Scene.of(samples, options.device, rng)
    field = Siren(options.widths_for(len(samples)))
    steps = options.steps_for(len(samples))
    method, started = (fit_wide, WIDE_STARTED) if len(field.widths) == 1 else (fit_deep, DEEP_STARTED)
    started = started if steps else 1.0

    def told(record: Record) -> None:
        if callback is not None:
            callback(record)
        advance(started + (1.0 - started) * record.step / steps)

    fitted = method(field, scene, options, rng, told, part(advance, 0.0, started))
    return NeuralSDF(field, fitted.theta, samples.frame, scene.box, options.as_dict()), fitted


def _support(samples: Samples) -> npt.NDArray[np.float32]:
    """Return the points, or some of them where they are many, in their order, of shape (N, 3)."""
    rows = np.arange(len(samples))
    if len(rows) > MOST_SUPPORT:
        # By chance, because a scanner's order has patterns; and by chance of its own, so that the fit's is untouched.
        rows = np.sort(np.random.default_rng(0).choice(rows, MOST_SUPPORT, replace=False))
    return samples.points[rows].astype(np.float32)
