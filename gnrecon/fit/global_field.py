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
from gnrecon.fit.objective import Scene
from gnrecon.fit.parameters import GlobalFieldParameters, ModelSelectionParameters, ObjectiveParameters
from gnrecon.fit.single_network import fit_wide
from gnrecon.geometry.arrays import Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import is_sign_certain
from gnrecon.optim import Solution
from gnrecon.runtime.progress import ProgressCallback, subrange

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GlobalField:
    """A global field, how it was solved, the scene that it saw, and the length of its features, in radii."""

    sdf: NeuralSDF
    solution: Solution
    scene: Scene
    length: float


def fit_global(
    samples: Samples,
    held: Mask,
    rows: Int,
    options: FitOptions,
    rng: np.random.Generator,
    advance: ProgressCallback,
    *,
    parameters: GlobalFieldParameters = GlobalFieldParameters(),
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
    smoothness = global_smoothness(samples, held, scene, rng.spawn(1)[0], parameters=parameters)
    spectrum = smooth_spectrum(smoothness.length, scene, parameters=parameters)
    field = Siren((parameters.units,))
    linear = replace(options, widths=field.widths, steps=0, smooth=None, fill=None, prior=None)

    def fitted(reach: float, advance: ProgressCallback) -> tuple[NeuralSDF, Solution, float]:
        solution = fit_wide(field, replace(scene, reach=reach), linear, rng, None, advance, spectrum)
        sdf = NeuralSDF(field, solution.theta, samples.frame, scene.box, options.as_dict())
        return sdf, solution, wrong_sign(sdf, scene, rng.spawn(1)[0])

    # Where more is asked of the surface in holes than the data says, normals may not carry it out of the box.
    plain_reach = ObjectiveParameters.normal_reach_spacings
    reach = plain_reach if options.regularisers else smoothness.reach
    sdf, solution, wrong = fitted(reach, subrange(advance, 0.0, 0.5))
    if reach > plain_reach and wrong > parameters.wrong_sign_share:
        plain, plainly, wrong_signs = fitted(plain_reach, subrange(advance, 0.5, 1.0))
        if wrong > wrong_signs + parameters.wrong_sign_share:
            reach, sdf, solution = plain_reach, plain, plainly
    _log.info(
        "The global field has %d features of length %.3g radii, and sees %d points; normals reach %.3g spacings.",
        parameters.units,
        spectrum.length,
        len(rows),
        reach,
    )
    return GlobalField(sdf, solution, scene, spectrum.length)


def wrong_sign(sdf: NeuralSDF, scene: Scene, rng: np.random.Generator) -> float:
    """Return the share of the free space where the field has the wrong sign beyond doubt, in [0, 1]."""
    x, distance = scene.volume(scene.volume_count, rng)
    other = sdf.sdf(sdf.frame.to_world(x)) * distance < 0
    certain = is_sign_certain(scene.coarse.winding_number(x[other]))
    return float(certain.sum() / max(len(x), 1))


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


def smooth_spectrum(
    length: float, scene: Scene, *, parameters: GlobalFieldParameters = GlobalFieldParameters()
) -> Spectrum:
    """Return the spectrum of a global field's features of a length in radii, or longer where points are few.

    It is that of the detail's features, with which the length is chosen, too.
    """
    return Spectrum(
        max(length, parameters.least_length_spacings * scene.coarse.spacing), FieldParameters.degrees_of_freedom
    )


def global_smoothness(
    samples: Samples,
    held: Mask,
    scene: Scene,
    rng: np.random.Generator,
    *,
    parameters: GlobalFieldParameters = GlobalFieldParameters(),
) -> Smoothness:
    """Return the length of features that a global field of the scan needs, and how far its normals reach.

    Parameters
    ----------
    samples : Samples
    held : mask of shape (N,), of the samples that are left out of `scene`
    scene : Scene
    rng : draws features and samples
    """
    if held.sum() < parameters.least_validation_points:
        return Smoothness(parameters.length_scales_radii[0], ObjectiveParameters.normal_reach_spacings)
    seen = rng.permutation(len(scene.samples))[: parameters.selection_points]
    x, distance = scene.volume(parameters.selection_volume_samples, rng)
    points, normals = scene.points[seen], scene.normals[seen]
    signed = scene.tensor(distance)
    center = torch.zeros(3).to(points)
    volume = scene.tensor(x), signed, signed, signed, signed.abs()
    patch = Patch(points, torch.zeros(len(points)).to(points), normals, *volume, center)
    features = Features.draw(parameters.selection_features, rng, points)
    out = np.flatnonzero(held)[: parameters.selection_points]
    left, turned = scene.tensor(samples.points[out]), scene.tensor(samples.normals[out])
    # Estimated ones are means of their neighbours', which smooth fields predict too well.
    ignored = samples.estimated and len(samples) <= ModelSelectionParameters.sparse_points
    reaches = parameters.normal_reaches_spacings[: 1 if ignored else None]
    noise = parameters.position_noise_spacings
    best = []
    for length in parameters.length_scales_radii:
        system, scores = PatchSystem(patch, features, length, parameters.field_deviation_radii), []
        for reach in reaches:
            amplitudes = system.solve(noise * scene.coarse.spacing, noise / reach)
            value, gradient = features.sums(amplitudes, left, center, length, 1)
            angle = (gradient - turned).norm(dim=1).mean()
            scores.append((float(value.abs().mean() + scene.coarse.spacing * angle), reach))
        best.append((length, *min(scores)))
    least = min(score for _, score, _ in best)
    length, _, reach = max(tried for tried in best if tried[1] <= (1 + parameters.tie_share) * least)
    return Smoothness(length, reach)
