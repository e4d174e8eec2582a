"""Decides whether noisy points are averaged before the local fit, by cross-validation.

A bilateral filter (`shape_priors.bilateral_filter`) is applied to the training points; the validation points stay as
they were scanned. Filters are compared with no filter on the same patches, patch by patch, and only for scans in which
noise was found. On some tens of patches a small gain is not significant, so that the shape decides: where faces meet at
sharp edges, points are averaged unless the patches contradict; elsewhere only if the gain is significant, because the
local fit smooths without a filter.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.local_solve import Hyperparameters
from gnrecon.fit.model_selection import CrossValidation, FieldResiduals, SelectedModel
from gnrecon.fit.parameters import DenoisingParameters
from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.fit.shape_priors.sharp_shape import SharpShape, has_edges
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.point_cloud import Samples

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LocalData:
    """Data of the local fit.

    Parameters
    ----------
    samples : averaged, or as scanned
    residuals : of the global field at the samples
    hyperparameters : length scale and noise
    averaging : the filter, or None
    """

    samples: Samples
    residuals: FieldResiduals
    hyperparameters: Hyperparameters
    averaging: BilateralFilter | None = None

    @classmethod
    def of_faces(cls, sdf: NeuralSDF, sharp: SharpShape) -> LocalData:
        """Return the data of a shape with sharp edges, whose samples and hyperparameters are known."""
        return cls(sharp.samples, FieldResiduals.of(sdf, sharp.samples), sharp.hyperparameters, sharp.averaging)


def choose_local_data(
    sdf: NeuralSDF,
    samples: Samples,
    held_out: Mask,
    features: int,
    rng: np.random.Generator,
    device: str,
    outliers: bool = False,
    *,
    parameters: DenoisingParameters = DenoisingParameters(),
) -> LocalData:
    """Select the filter, if any, and the hyperparameters that predict the validation points best.

    A clean scan is not averaged, and its hyperparameters follow from its points.

    Parameters
    ----------
    sdf : the global field, in the samples' frame
    samples : all of them
    held_out : mask of shape (N,), of the validation points, to which the global field was not fitted
    features : number of features a cube
    rng : draws patches and features
    device : a torch device
    outliers : whether some were found; those that remain would make spikes if the scan were fitted as clean
    parameters : of the filters and their selection
    """
    residuals = FieldResiduals.of(sdf, samples)
    radius = residuals.density.radius
    validation = CrossValidation.draw(residuals, held_out, radius, rng, device, features)
    clean = None if outliers else validation.clean()
    if clean is not None:
        return LocalData(samples, residuals, clean)
    selected = validation.select()
    # The marginal likelihood is not robust to outliers that remain.
    plain = selected.hyperparameters if outliers else selected.best
    # Estimated normals are means over edges already. The factor keeps noise that equals the limit but for rounding.
    if samples.estimated or selected.hyperparameters.position <= 1.001 * parameters.least_noise_disk_radii * radius:
        return LocalData(samples, residuals, plain)

    def with_kept(averaging: BilateralFilter) -> CrossValidation:
        points, normals = samples.points.copy(), samples.normals.copy()
        points[~held_out], normals[~held_out] = averaging.apply(points[~held_out], normals[~held_out])
        # Averaged points have correlated noise, for which the marginal likelihood is wrong.
        of_averaged = FieldResiduals.of(sdf, replace(samples, points=points, normals=normals, noise=None))
        return replace(validation, residuals=of_averaged, likelihood=None)

    first = _candidates(parameters)[0]
    found = _best(selected, with_kept, lambda: has_edges(*first.apply(samples.points, samples.normals)), parameters)
    if found is None:
        return LocalData(samples, residuals, plain)
    averaging, better = found
    points, normals = averaging.apply(samples.points, samples.normals)
    samples = replace(samples, points=points, normals=normals)
    _log.info("Points are averaged over %.2g radii of their disks where normals agree.", averaging.width_radii)
    return LocalData(samples, FieldResiduals.of(sdf, samples), better.select().hyperparameters, averaging)


def _best(
    selected: SelectedModel,
    kept_averaged: Callable[[BilateralFilter], CrossValidation],
    edges: Callable[[], bool],
    parameters: DenoisingParameters = DenoisingParameters(),
) -> tuple[BilateralFilter, CrossValidation] | None:
    """Return the filter that predicts best and its cross-validation, or None if no filter is better.

    Edges are looked for only if the patches do not decide. All filters are compared at the length scale of the scanned
    points; a better one is selected afterwards.
    """
    plain = _of_best_noise(selected.scores)
    first, *others = _candidates(parameters)

    def tried(averaging: BilateralFilter) -> tuple[Float, CrossValidation]:
        validation = kept_averaged(averaging)
        return plain - _of_best_noise(validation.scores(selected.hyperparameters.length)), validation

    gain, validation = tried(first)
    error = gain.std() / np.sqrt(len(gain))
    if not (gain.mean() > parameters.gain_standard_errors * error or (gain.mean() > -error and edges())):
        return None
    best, averaging = float(gain.mean()), first
    for other in others:
        gain, of_other = tried(other)
        if gain.mean() > best:
            best, averaging, validation = float(gain.mean()), other, of_other
    return averaging, validation


def _candidates(parameters: DenoisingParameters) -> list[BilateralFilter]:
    """Return the filters to try, of which the others are tried only where the first one helps."""
    return [BilateralFilter(width, parameters.normal_difference) for width in parameters.widths_disk_radii]


def _of_best_noise(scores: Float) -> Float:
    """Return the patches' scores, of shape (patches,), of the noise that is best on the mean of (patches, noises)."""
    best: Float = scores[:, int(scores.mean(axis=0).argmin())]
    return best
