"""The smooth global field of a scan: one wide layer of sine features, as long as the shape lets them be (`smoothness`).

Normals may weigh as much in it as they are worth. But a shape with more detail than the layer can follow pays for exact
normals with sheets in free space; where the winding number contradicts the field beyond doubt, normals weigh little.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import torch

from gnrecon.field.field_parameters import FieldParameters
from gnrecon.field.networks import Siren
from gnrecon.field.random_features import Features
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.initialisation import Spectrum
from gnrecon.fit.local_solve import Patch, PatchSystem
from gnrecon.fit.model_selection import SPARSE
from gnrecon.fit.objective import REACH, Scene
from gnrecon.fit.single_network import fit_wide
from gnrecon.geometry.arrays import Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import is_certain
from gnrecon.optim import Solution
from gnrecon.runtime.progress import ProgressCallback, part

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
    samples: Samples, held: Mask, rows: Int, options: FitOptions, rng: np.random.Generator, advance: ProgressCallback
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

    def fitted(reach: float, advance: ProgressCallback) -> tuple[NeuralSDF, Solution, float]:
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


LENGTHS = (0.25, 0.5, 1.0)
"""Lengths to choose from, in radii."""

REACHES = (REACH, 1.2, 3.0, 8.0, 20.0)
"""Weights of the normals to choose from: the lengths, in spacings, over which an angle counts as a height."""

SPACINGS = 4.0
"""Least length of a global field's features, in spacings of the points that it sees: shorter ones oscillate."""

ALIKE = 0.01
"""Share by which a longer one may predict worse than the best."""

FEATURES, POINTS, VOLUME = 600, 2000, 2000

POSITION = 0.1
"""Noise of positions that is assumed, in spacings; that of normals, in radians, is this over the reach."""

LEAST_HELD = 5
"""Left-out points that have a say."""

SIZE = 1.0
"""Standard deviation of the field, in radii."""


# How smooth a scan's shape is as a whole, and what its normals are worth, chosen by left-out points.
#
# A blob, a pipe or a plate has few degrees of freedom, and a field of long features averages the noise of many points
# and closes wide holes well; a gear or a foam needs short ones. Exact normals tell more of a smooth shape than noisy
# points do; of coarse or scattered ones it is the other way round. Small fields of each length and weight of the
# normals are fitted to some of the points, as a cube's correction is (`patch`), and the longest one counts that
# predicts the points that are left out as well as the best, with the weight at which it does.


@dataclass(frozen=True)
class Smoothness:
    """Length of the global field's features, in radii, and reach of its normals, in spacings."""

    length: float
    reach: float


def smooth_spectrum(length: float, scene: Scene) -> Spectrum:
    """Return the spectrum of a global field's features of a length in radii, or longer where points are few.

    It is that of the detail's features, with which the length is chosen, too.
    """
    return Spectrum(max(length, SPACINGS * scene.coarse.spacing), FieldParameters.degrees_of_freedom)


def global_smoothness(samples: Samples, held: Mask, scene: Scene, rng: np.random.Generator) -> Smoothness:
    """Return the length of features that a global field of the scan needs, and how far its normals reach.

    Parameters
    ----------
    samples : Samples
    held : mask of shape (N,), of the samples that are left out of `scene`
    scene : Scene
    rng : draws features and samples
    """
    if held.sum() < LEAST_HELD:
        return Smoothness(LENGTHS[0], REACH)
    seen = rng.permutation(len(scene.samples))[:POINTS]
    x, distance = scene.volume(VOLUME, rng)
    points, normals = scene.points[seen], scene.normals[seen]
    signed = scene.tensor(distance)
    center = torch.zeros(3).to(points)
    volume = scene.tensor(x), signed, signed, signed, signed.abs()
    patch = Patch(points, torch.zeros(len(points)).to(points), normals, *volume, center)
    features = Features.draw(FEATURES, rng, points)
    out = np.flatnonzero(held)[:POINTS]
    left, turned = scene.tensor(samples.points[out]), scene.tensor(samples.normals[out])
    # Estimated ones are means of their neighbours', which smooth fields predict too well.
    reaches = REACHES[:1] if samples.estimated and len(samples) <= SPARSE else REACHES
    best = []
    for length in LENGTHS:
        system, scores = PatchSystem(patch, features, length, SIZE), []
        for reach in reaches:
            amplitudes = system.solve(POSITION * scene.coarse.spacing, POSITION / reach)
            value, gradient = features.sums(amplitudes, left, center, length, 1)
            angle = (gradient - turned).norm(dim=1).mean()
            scores.append((float(value.abs().mean() + scene.coarse.spacing * angle), reach))
        best.append((length, *min(scores)))
    least = min(score for _, score, _ in best)
    length, _, reach = max(tried for tried in best if tried[1] <= (1 + ALIKE) * least)
    return Smoothness(length, reach)
