"""Length scale and noise of a scan by cross-validation on held-out points.

Around some points of the scan a patch is fitted, without the validation points, for several length scales and noises.
The score of each is the mean distance of the validation points from the predicted surface, |f| / (n . grad f), plus the
difference of the gradient there from their normal n, as a height over the radius of the disk that a point stands for.
The distance alone would not do: a field that is zero and flat around all points has none.

Validation points are few, and have noise of their own. Where normals are given, the noise is therefore that of the
largest marginal likelihood of all points (`marginal_likelihood`), and validation points select the length scale for it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.free_space import Volume
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_solve import Patch, patch_system, precise_enough
from gnrecon.fit.marginal_likelihood import MarginalLikelihood, SurfaceLikelihood, clean_noise
from gnrecon.fit.parameters import (
    LocalSolveParameters,
    MarginalLikelihoodParameters,
    ModelSelectionParameters,
    SurfaceLikelihoodParameters,
)
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.runtime.parallel import map_in_threads


@dataclass(frozen=True)
class Hyperparameters:
    """Length scale and noise of a scan, the hyperparameters of the Gaussian process.

    Parameters
    ----------
    length : over which the surface's shape varies, unit coordinates
    position : of the points' noise along the normal, unit coordinates
    angle : of the normals' noise, radians
    by_place : whether the length is that of the scan on the whole, from which each cube's own may differ
    rms_factor : prior standard deviation of a cube's correction, over the RMS of the residuals there
    robust : whether points that contradict the others of their cube lose their weight
    by_slopes : whether the prior standard deviation is wide enough for the slopes that the data ask for, too
    """

    length: float
    position: float
    angle: float
    by_place: bool = False
    rms_factor: float = LocalSolveParameters.correction_rms_factor
    robust: bool = False
    by_slopes: bool = False


def select_hyperparameters(
    residuals: FieldResiduals,
    held_out: Mask,
    radius: float,
    rng: np.random.Generator,
    device: str = "cpu",
    *,
    outliers: bool = False,
) -> Hyperparameters:
    """Return the hyperparameters of a clean scan, or for any other those that predict the validation points best.

    The noise is then that of the largest marginal likelihood, unless normals were estimated or there are outliers.

    Parameters
    ----------
    residuals : at the points
    held_out : mask of shape (N,), of the validation points
    radius : of the disk that a point stands for, unit coordinates
    rng : draws patches and features
    device : a torch device
    outliers : whether some were found. Those that remain would make spikes if the scan were fitted as clean, and the
        marginal likelihood is not robust to them.
    """
    # Draws of its own, so that later ones do not depend on the number of patches.
    rng = rng.spawn(1)[0]
    clean = None if outliers else _of_clean_scan(residuals, held_out, radius, rng.spawn(1)[0], device)
    if clean is not None:
        return clean
    if residuals.estimated and len(residuals) <= ModelSelectionParameters.sparse_points:
        chosen = _by_positions(residuals, radius, rng, device)
    else:
        validation = CrossValidation.draw(residuals, held_out, radius, rng, device)
        chosen = (replace(validation, likelihood=None) if outliers else validation).select()
    return replace(chosen, robust=outliers)


def _of_clean_scan(
    residuals: FieldResiduals,
    held_out: Mask,
    radius: float,
    rng: np.random.Generator,
    device: str,
    *,
    parameters: ModelSelectionParameters = ModelSelectionParameters(),
) -> Hyperparameters | None:
    """Return the hyperparameters of a clean scan, or None of any other; see `select_hyperparameters`.

    Its noise follows from the points. Its length is the likeliest, or the one of the validation points if that is
    shorter, as both err towards longer ones: flat faces outweigh edges in a likelihood of equally curved surfaces,
    and validation points lie a spacing away from all others, farther than most of the surface.
    """
    scan = residuals.points, residuals.normals, residuals.density
    if (noise := clean_noise(*scan, residuals.rms, residuals.estimated, residuals.clean)) is None:
        return None
    if residuals.deviations is not None:
        noise = noise[0], residuals.angle
        every = (parameters.short_length_disk_radii, *parameters.lengths_disk_radii)
        parameters = replace(parameters, lengths_disk_radii=every)
    # Estimated normals follow from the positions, and are no data.
    deviation = SurfaceLikelihoodParameters.angle_radians if residuals.estimated else noise[1]
    likelihood = patch_likelihood(residuals, radius, rng, device)
    lengths = [each * radius for each in parameters.lengths_disk_radii]
    length = likelihood.likeliest_length(lengths, noise[0], deviation)
    if length > lengths[0]:
        validation = CrossValidation.draw(residuals, held_out, radius, rng, device, parameters=parameters)
        length = min(length, replace(validation, known=noise).length_of_clean_scan())
    return Hyperparameters(length, *noise)


def _by_positions(
    residuals: FieldResiduals,
    radius: float,
    rng: np.random.Generator,
    device: str,
    *,
    lengths: Sequence[float] = ModelSelectionParameters.lengths_disk_radii,
    parameters: SurfaceLikelihoodParameters = SurfaceLikelihoodParameters(),
) -> Hyperparameters:
    """Return the hyperparameters of the largest marginal likelihood of the positions; see `select_hyperparameters`."""
    scan = residuals.points, residuals.value, residuals.gradient
    likelihood = SurfaceLikelihood.of(*scan, rng, device, parameters=parameters)
    length, size, noise = likelihood.likeliest([each * radius for each in lengths])
    noise = max(noise, ModelSelectionParameters.least_position_noise_disk_radii * radius)
    return Hyperparameters(length, noise, parameters.angle_radians, rms_factor=size / max(residuals.rms, 1e-6))


def patch_likelihood(
    residuals: FieldResiduals,
    radius: float,
    rng: np.random.Generator,
    device: str,
    *,
    parameters: MarginalLikelihoodParameters = MarginalLikelihoodParameters(),
) -> MarginalLikelihood:
    """Return the marginal likelihood of random patches; the parameters are those of `select_hyperparameters`."""
    count = min(parameters.patches, len(residuals))
    centers = residuals.points[rng.choice(len(residuals), count, replace=False)]
    ranks = list(range(1, min(parameters.patch_points, len(residuals)) + 1))
    near = residuals.density.tree.query(centers, ranks)[1]
    pairs = zip(np.sort(near), centers, strict=True)
    patches = [residuals.patch(rows, center, Volume.none(), device) for rows, center in pairs]
    return MarginalLikelihood.of(patches, radius, rng, device, parameters=parameters)


def _is_gain(gain: Float, standard_errors: float) -> bool:
    """Return whether the mean of gains, of shape (patches,), is more than so many of its standard errors."""
    return bool(gain.mean() > standard_errors * gain.std() / np.sqrt(len(gain)))


def _noise_candidates(parameters: ModelSelectionParameters) -> list[tuple[float, float]]:
    """Return the pairs of position noise, in disk radii, and angle noise, in radians, that are tried."""
    return list(itertools.product(parameters.position_noises_disk_radii, parameters.angle_noises_radians))


def _smoothest(
    scores: dict[int, Float], *, parameters: ModelSelectionParameters = ModelSelectionParameters()
) -> tuple[int, int]:
    """Return the numbers of the length and of the noise that assume most noise and are as good as the best.

    As good means within one standard error of the best, patch against patch, or within a share of it. Noise that is
    correlated among neighbours, as where several scans do not quite match, is underestimated by single points.
    Source: the one-standard-error rule, Hastie et al., The Elements of Statistical Learning (2009), section 7.10.

    Parameters
    ----------
    scores : for each number of a length, of shape (patches, noises)
    """
    numbers = sorted(scores)
    table = np.stack([scores[number] for number in numbers], axis=1)
    mean = table.mean(axis=0)
    best = np.unravel_index(int(np.argmin(mean)), mean.shape)
    excess = table - table[:, best[0], best[1]][:, None, None]
    tolerance = np.maximum(excess.std(axis=0) / np.sqrt(len(table)), parameters.tie_share * mean[best])
    noises, lengths = _noise_candidates(parameters), parameters.lengths_disk_radii
    equal = [(noises[c][0], lengths[numbers[n]], n, c) for n, c in np.argwhere(excess.mean(axis=0) <= tolerance)]
    _, _, row, noise = max(equal)
    return numbers[int(row)], int(noise)


@dataclass(frozen=True)
class CrossValidation:
    """Patches and the validation points that they predict.

    Parameters
    ----------
    residuals : that the patches are fitted to, and validation points
    radius : of the disk that a point stands for, unit coordinates
    features : of the patches
    centers : of the patches, of shape (patches, 3)
    predicted : rows of the validation points that each patch predicts
    held_out : mask of shape (N,), of the validation points
    device : a torch device
    known : noise of positions and normals, if it is known; then no other is tried
    likelihood : which gives the noise of each length; None of estimated normals, whose errors are correlated, and of
        scans with outliers, to which it is not robust. Then candidates are tried.
    """

    residuals: FieldResiduals
    radius: float
    features: Features
    centers: Float
    predicted: Sequence[Int]
    held_out: Mask
    device: str
    known: tuple[float, float] | None = None
    likelihood: MarginalLikelihood | None = None
    parameters: ModelSelectionParameters = ModelSelectionParameters()
    _noises: dict[float, list[tuple[float, float]]] = field(default_factory=dict, init=False, repr=False)
    _scored: dict[float, Float] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def draw(
        cls,
        residuals: FieldResiduals,
        held_out: Mask,
        radius: float,
        rng: np.random.Generator,
        device: str,
        *,
        parameters: ModelSelectionParameters = ModelSelectionParameters(),
    ) -> CrossValidation:
        """Draw the patches; see `select_hyperparameters` for the parameters."""
        out = np.flatnonzero(held_out)
        covering = parameters.predictions * len(out) // parameters.patch_validation_points
        patches = min(max(covering, parameters.least_patches), parameters.most_patches)
        chosen = rng.choice(len(residuals), min(patches, len(residuals)), replace=False)
        # As a list, so that the answer has two dimensions also where a single point is left out.
        ranks = list(range(1, min(parameters.patch_validation_points, len(out)) + 1))
        near = cKDTree(residuals.points[out]).query(residuals.points[chosen], ranks)[1]
        features = Features.draw(parameters.features, rng, torch.zeros(0, dtype=torch.float64, device=device))
        centers = residuals.points[chosen]
        likelihood = None if residuals.estimated else patch_likelihood(residuals, radius, rng.spawn(1)[0], device)
        found = list(out[near])
        return cls(residuals, radius, features, centers, found, held_out, device, None, likelihood, parameters)

    def length_of_clean_scan(self) -> float:
        """Return the shortest length that the next longer one does not beat by two standard errors.

        Clean points justify the shortest; longer ones are better only where the points, or a cube's features, are too
        few for it.
        """
        number, count = 0, len(self.parameters.lengths_disk_radii)
        while number + 1 < count and self._clearly_better(number + 1, number):
            number += 1
        return self._length(number)

    def select(self) -> Hyperparameters:
        """Return the hyperparameters that predict best, with the likeliest noise where it is known."""
        scores: dict[int, Float] = {}

        def best(number: int) -> Float:
            """Return the scores of a length's best noise, of shape (patches,)."""
            scores[number] = self.scores(self._length(number))
            return scores[number][:, int(scores[number].mean(axis=0).argmin())]

        def is_better(number: int, than: int, standard_errors: float) -> bool:
            if not 0 <= number < len(self.parameters.lengths_disk_radii):
                return False
            return _is_gain(best(than) - best(number), standard_errors)

        at = self.parameters.first_length_index
        step = 1 if is_better(at + 1, at, 0.0) else -1
        # Where no length predicts better than the one before but by chance, the search is at its end.
        while is_better(at + step, at, self.parameters.search_standard_errors):
            at += step
        # The share of ties is for noise that is correlated, which no likelihood decides.
        tie_share = self.parameters.tie_share if self.likelihood is None else 0.0
        number, noise = _smoothest(scores, parameters=replace(self.parameters, tie_share=tie_share))
        # Errors of dense scans are alike among neighbours, as those of estimated normals are.
        by_place = self.likelihood is not None and len(self.residuals) <= self.parameters.sparse_points
        return Hyperparameters(self._length(number), *self.noises(self._length(number))[noise], by_place)

    def _length(self, number: int) -> float:
        """Return a length scale, unit coordinates, by its number."""
        return self.parameters.lengths_disk_radii[number] * self.radius

    def _clearly_better(self, number: int, than: int) -> bool:
        """Return whether a length's score is better than another's by more than some standard errors.

        Logarithms are compared: one patch where both lengths are far off would outweigh all others.
        """
        gain = np.log(self.scores(self._length(than))[:, 0]) - np.log(self.scores(self._length(number))[:, 0])
        return _is_gain(gain, self.parameters.gain_standard_errors)

    def noises(self, length: float) -> list[tuple[float, float]]:
        """Return the noises of positions and normals to try with a length: one, where it is known or the likeliest."""
        if self.known is not None:
            return [self.known]
        if length not in self._noises:
            # With estimated normals, few validation points hardly tell a smooth field from one that winds through all.
            least, most = 0.0, max(self.residuals.rms, self.parameters.least_position_noise_disk_radii * self.radius)
            if self.residuals.estimated and (shown := self.residuals.noise):
                least, most = shown / self.parameters.most_noise_factor, shown * self.parameters.most_noise_factor
            if self.likelihood is None:
                tried = [(position * self.radius, angle) for position, angle in _noise_candidates(self.parameters)]
            else:
                tried = [self.likelihood.likeliest(length)]
            self._noises[length] = [(min(max(position, least), most), angle) for position, angle in tried]
        return self._noises[length]

    def scores(self, length: float) -> Float:
        """Return the scores of a length, of shape (patches, noises), in radii; each length is tried once."""
        if length not in self._scored:
            self.noises(length)  # once, before patches use them in parallel
            found = map_in_threads(lambda number: self._scores(number, length), range(len(self.centers)), self.device)
            self._scored[length] = np.array(found) / self.radius
        return self._scored[length]

    def _scores(self, number: int, length: float) -> list[float]:
        """Return the scores of one patch for each choice of noise."""
        center, predicted = self.centers[number], self.predicted[number]
        reach = (
            np.linalg.norm(self.residuals.points[predicted] - center, axis=1).max()
            + self.parameters.margin_lengths * length
        )
        rows = self.residuals.within(center, reach)
        rows = rows[~self.held_out[rows]]
        # The nearest of more points suffice, and time would grow with the square of the length.
        most = self.parameters.most_patch_points
        if len(rows) > most:
            far = np.linalg.norm(self.residuals.points[rows] - center, axis=1)
            rows = rows[np.sort(np.argsort(far, kind="stable")[:most])]
        patch = self.residuals.patch(rows, center, Volume.none(), self.device)
        noises = self.noises(length)
        features = precise_enough(self.features, len(patch.value), length, patch.size, np.min(noises, axis=0))
        system = patch_system(patch, features, length, patch.size)
        target = self.residuals.patch(predicted, center, Volume.none(), self.device)
        normals = torch.as_tensor(self.residuals.normals[predicted], device=self.device)
        # On a nearly exact scan, the limit by the residuals makes several noises equal.
        found = {each: self._score(system.solve(*each), target, normals, length) for each in set(noises)}
        return [found[each] for each in noises]

    def _score(self, amplitudes: Tensor, target: Patch, normals: Tensor, length: float) -> float:
        value, gradient = self.features.sums(amplitudes, target.points, target.center, length, 1)
        # Target minus prediction: f + c and grad(f + c) - n, but for the sign.
        missing, turn = target.value - value, target.gradient - gradient
        slope = 1.0 - (turn * normals).sum(dim=1)
        if self.residuals.estimated and len(self.residuals) <= self.parameters.sparse_points:
            # Such normals are means of their neighbours', which a field that is too smooth predicts best. So distances
            # alone count, and a field that is steep because it winds through every point is not nearer for that.
            return float((missing.abs() / slope.clamp(self.parameters.least_slope, 1.0)).mean())
        distance = missing.abs() / slope.clamp_min(self.parameters.least_slope)
        return float(distance.mean() + self.radius * turn.norm(dim=1).mean())
