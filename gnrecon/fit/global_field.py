"""The smooth global field of a scan: one wide layer of sine features, as long as the shape lets them be (`smoothness`).

Normals may weigh as much in it as they are worth. But a shape with more detail than the layer can follow pays for exact
normals with sheets in free space; where the winding number contradicts the field beyond doubt, normals weigh little.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from gnrecon.field.networks import Siren
from gnrecon.fit.options import FitOptions
from gnrecon.fit.scene import REACH, Scene
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.fit.smoothness import global_smoothness, smooth_spectrum
from gnrecon.fit.wide import fit_wide
from gnrecon.geometry.arrays import Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import is_certain
from gnrecon.optim import Solution
from gnrecon.runtime.progress import Advance, part

_log = logging.getLogger(__name__)

UNITS = 1000

FEW = 4e-3
"""Share of the free space by which normals that weigh more may spoil its sign."""


@dataclass(frozen=True)
class GlobalField:
    """A global field, how it was solved, the scene that it saw, and the length of its features, in radii."""

    sdf: NeuralSDF
    solution: Solution
    scene: Scene
    length: float


def fit_global(
    samples: Samples, held: Mask, rows: Int, options: FitOptions, rng: np.random.Generator, advance: Advance
) -> GlobalField:
    """Fit the smooth field to some of the samples.

    Parameters
    ----------
    samples : Samples
    held : mask of shape (N,), of samples that the field does not see, on which its smoothness is chosen
    rows : of the samples that it sees, none of them held
    options : of which the device, the residual of the normals and the solver are used
    rng : draws features and samples of the volume
    advance : told of the share that is done

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    seen = replace(samples, points=samples.points[rows], normals=samples.normals[rows])
    scene = Scene.of(seen, options.device, rng)
    smoothness = global_smoothness(samples, held, scene, rng.spawn(1)[0])
    spectrum = smooth_spectrum(smoothness.length, scene)
    field = Siren((UNITS,))
    linear = replace(options, widths=field.widths, steps=0, smooth=None, fill=None, prior=None)

    def fitted(reach: float, advance: Advance) -> tuple[NeuralSDF, Solution, float]:
        solution = fit_wide(field, replace(scene, reach=reach), linear, rng, None, advance, spectrum)
        sdf = NeuralSDF(field, solution.theta, samples.frame, scene.box, options.as_dict())
        return sdf, solution, wrong_sign(sdf, scene, rng.spawn(1)[0])

    # Where more is asked of the surface in holes than the data says, normals may not carry it out of the box.
    reach = REACH if options.regularisers else smoothness.reach
    sdf, solution, wrong = fitted(reach, part(advance, 0.0, 0.5))
    if reach > REACH and wrong > FEW:
        plain, plainly, ghosts = fitted(REACH, part(advance, 0.5, 1.0))
        if wrong > ghosts + FEW:
            reach, sdf, solution = REACH, plain, plainly
    _log.info(
        "The global field has %d features of length %.3g radii, and sees %d points; normals reach %.3g spacings.",
        UNITS,
        spectrum.length,
        len(rows),
        reach,
    )
    return GlobalField(sdf, solution, scene, spectrum.length)


def wrong_sign(sdf: NeuralSDF, scene: Scene, rng: np.random.Generator) -> float:
    """Return the share of the free space where the field has the wrong sign beyond doubt, in [0, 1]."""
    x, distance = scene.volume(scene.volume_count, rng)
    other = sdf.sdf(sdf.frame.to_world(x)) * distance < 0
    certain = is_certain(scene.coarse.winding_number(x[other]))
    return float(certain.sum() / max(len(x), 1))
