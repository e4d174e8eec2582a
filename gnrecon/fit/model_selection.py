"""Length and noise of a scan, chosen by what they predict where data is left out.

Around some points of the scan a patch is fitted without some points, which the global field has not seen either, for
several lengths and noises. The score of each is what the left-out points then say: their mean distance to the predicted
surface, |f| / (n . grad f), and how far the gradient there is from their normal n, as a height over the radius of the
disk that a point stands for. The distance alone would not do: where noisy points are closer than they are exact, a
field that is zero and flat around all of them has none.

Left-out points are few, and have noise of their own. Where normals are given, all points tell the noise better, by its
evidence (`evidence`), and the left-out ones choose the length for it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.local_solve import Hyperparameters, Patch, patch_system
from gnrecon.fit.marginal_likelihood import MarginalLikelihood, clean_noise
from gnrecon.fit.parameters import MarginalLikelihoodParameters, ModelSelectionParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.runtime.parallel import map_in_threads


@dataclass(frozen=True)
class FieldResiduals:
    """What a global field leaves over at the points: everything of shape (N,) or (N, 3), unit coordinates.

    `estimated` says that the normals were found from the points.
    """

    points: Float
    normals: Float
    value: Float
    gradient: Float
    estimated: bool = False

    @classmethod
    def of(cls, sdf: NeuralSDF, samples: Samples) -> FieldResiduals:
        """Return what a field leaves over at samples."""
        value, gradient = sdf.sdf_and_gradient(samples.frame.to_world(samples.points))
        return cls(samples.points, samples.normals, value / samples.frame.scale, gradient, samples.estimated)

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def density(self) -> Density:
        """How densely the points lie."""
        return Density(self.points)

    @cached_property
    def over(self) -> float:
        """Root mean square of the values that are left over."""
        return float(np.sqrt(np.mean(self.value**2)))

    def within(self, center: Float, reach: float) -> Int:
        """Return the rows of the points in the cube of half an edge `reach` about a centre, in order."""
        return np.sort(np.array(self.density.tree.query_ball_point(center, reach, p=np.inf), dtype=np.int64))

    def patch(self, rows: Int, center: Float, volume: Volume, device: str) -> Patch:
        """Return the patch of some rows, with samples of the volume."""
        turn = self.normals[rows] - self.gradient[rows]
        arrays = (self.points[rows], -self.value[rows], turn, *volume.rows(), center)
        return Patch(*(torch.as_tensor(values, device=device) for values in arrays))


@dataclass(frozen=True)
class Volume:
    """Samples of space, of shape (Q, 3), where a correction is known roughly; the rest of shape (Q,).

    Parameters
    ----------
    wanted : what it should be
    lower, upper : what it must be at least, and at most
    distance : how far the data is
    """

    points: Float
    wanted: Float
    lower: Float
    upper: Float
    distance: Float

    @classmethod
    def around(
        cls,
        points: Float,
        own: Float,
        signed: Float,
        certain: Mask,
        distance: Float,
        *,
        parameters: ModelSelectionParameters = ModelSelectionParameters(),
    ) -> Volume:
        """Return samples at which a field is to be about the coarse distance, and of its sign where that is certain.

        A field that is somewhat steeper or flatter than a distance needs no correction: one that brought it to the
        distance would go too far between samples, and make a horn. Nor does one of the other sign where neither sign is
        beyond doubt, as in a cavity of which little was seen: the field there is smooth, and closes it no worse.

        Parameters
        ----------
        points : array of shape (Q, 3)
        own, signed : arrays of shape (Q,), the field, and the coarse distance
        certain : mask of shape (Q,), where the sign of that is beyond doubt
        distance : array of shape (Q,), of the data
        """
        near, far = parameters.least_field_share * signed, parameters.most_field_share * signed
        agreed = certain | (own * signed > 0)
        wanted = np.where(agreed, own.clip(np.minimum(near, far), np.maximum(near, far)) - own, 0.0)
        bound = parameters.sign_bound_share * signed - own
        lower = np.where(certain & (signed > 0), bound, -np.inf)
        upper = np.where(certain & (signed < 0), bound, np.inf)
        return cls(points, wanted, lower, upper, distance)

    @classmethod
    def none(cls) -> Volume:
        """Return no samples."""
        return cls(np.zeros((0, 3)), *np.zeros((4, 0)))

    def rows(self) -> tuple[Float, Float, Float, Float, Float]:
        """Return all five arrays."""
        return self.points, self.wanted, self.lower, self.upper, self.distance


@dataclass(frozen=True)
class SelectedModel:
    """What left-out points choose.

    Parameters
    ----------
    belief : of the tabled noises
    scores : of its length at each patch with each tabled noise, of shape (patches, noises), in radii
    evident : belief of the noise that has most evidence at its length; None where points do not tell it
    """

    hyperparameters: Hyperparameters
    scores: Float
    most_likely: Hyperparameters | None = None

    @property
    def best(self) -> Hyperparameters:
        """Return the belief for points as they were scanned."""
        return self.most_likely or self.hyperparameters


def select_hyperparameters(
    residuals: FieldResiduals, held: Mask, radius: float, rng: np.random.Generator, device: str = "cpu"
) -> Hyperparameters:
    """Return the belief that a clean scan tells by itself, and of any other that which predicts left-out points best.

    The noise is then that of most evidence (`evidence`), unless normals were estimated.

    Parameters
    ----------
    leftover : Leftover
    held : mask of shape (N,), of the points that are left out
    radius : of the disk that a point stands for, unit coordinates
    rng : draws patches, features and what is left out
    device : a torch device
    """
    validation = CrossValidation.draw(residuals, held, radius, rng, device)
    return validation.clean() or validation.choice().best


def _marginal_likelihood(
    residuals: FieldResiduals,
    radius: float,
    rng: np.random.Generator,
    device: str,
    *,
    parameters: MarginalLikelihoodParameters = MarginalLikelihoodParameters(),
) -> MarginalLikelihood:
    """Return the evidence of points about places that are drawn; the other parameters as those of `choose`."""
    count = min(parameters.patches, len(residuals))
    centers = residuals.points[rng.choice(len(residuals), count, replace=False)]
    ranks = list(range(1, min(parameters.patch_points, len(residuals)) + 1))
    near = residuals.density.tree.query(centers, ranks)[1]
    pairs = zip(np.sort(near), centers, strict=True)
    patches = [residuals.patch(rows, center, Volume.none(), device) for rows, center in pairs]
    return MarginalLikelihood.of(patches, radius, rng, device, parameters=parameters)


def _noise_candidates(parameters: ModelSelectionParameters) -> list[tuple[float, float]]:
    """Return the pairs of position noise, in disk radii, and angle noise, in radians, that are tried."""
    return list(itertools.product(parameters.position_noises_disk_radii, parameters.angle_noises_radians))


def _smoothest(
    scores: dict[int, Float], *, parameters: ModelSelectionParameters = ModelSelectionParameters()
) -> tuple[int, int]:
    """Return the number of the length and of the noise that assume most noise, and are as good as the best.

    As good is what lies within its standard error of the best, patch against patch, or within a share. Noise that is
    alike among neighbours, as that of scans that do not quite match, shows little where single points are left out.
    Source: the one-standard-error rule, Hastie et al., The Elements of Statistical Learning (2009), section 7.10.

    Parameters
    ----------
    scores : for each number of a length, of shape (patches, noises)
    """
    numbers = sorted(scores)
    table = np.stack([scores[number] for number in numbers], axis=1)
    mean = table.mean(axis=0)
    best = np.unravel_index(int(np.argmin(mean)), mean.shape)
    over = table - table[:, best[0], best[1]][:, None, None]
    tolerance = np.maximum(over.std(axis=0) / np.sqrt(len(table)), parameters.tie_share * mean[best])
    noises, lengths = _noise_candidates(parameters), parameters.lengths_disk_radii
    alike = [(noises[c][0], lengths[numbers[n]], n, c) for n, c in np.argwhere(over.mean(axis=0) <= tolerance)]
    _, _, row, choice = max(alike)
    return numbers[int(row)], int(choice)


@dataclass(frozen=True)
class CrossValidation:
    """Patches with what they are to predict.

    Parameters
    ----------
    leftover : what the patches are fitted to
    told : what the left-out points say, whose rows are those of `leftover`
    radius : of the disk that a point stands for, unit coordinates
    features : of the patches
    centers : of the patches, of shape (patches, 3)
    predicted : rows of the left-out points that each patch predicts
    held : mask of shape (N,), of the points that are left out
    device : a torch device
    known : noise of positions and normals, where it is known; then no other is tried
    evidence : which tells one more noise for each length; None of estimated normals, which are alike by what they are
        means of, and not by the surface alone
    """

    residuals: FieldResiduals
    told: FieldResiduals
    radius: float
    features: Features
    centers: Float
    predicted: Sequence[Int]
    held: Mask
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
        held: Mask,
        radius: float,
        rng: np.random.Generator,
        device: str,
        cube_features: int = ModelSelectionParameters.features,
        *,
        parameters: ModelSelectionParameters = ModelSelectionParameters(),
    ) -> CrossValidation:
        """Draw the patches, for cubes of so many features; the other parameters as those of `choose`."""
        out = np.flatnonzero(held)
        dense = len(residuals) > parameters.dense_points
        patches = parameters.dense_patches if dense else parameters.patches
        # What is to predict a cube of few features resolves no more than it.
        few = dense or cube_features <= parameters.dense_features
        count = parameters.dense_features if few else parameters.features
        chosen = rng.choice(len(residuals), min(patches, len(residuals)), replace=False)
        # As a list, so that the answer has two dimensions also where a single point is left out.
        ranks = list(range(1, min(parameters.patch_validation_points, len(out)) + 1))
        near = cKDTree(residuals.points[out]).query(residuals.points[chosen], ranks)[1]
        features = Features.draw(count, rng, torch.zeros(0, dtype=torch.float64, device=device))
        centers = residuals.points[chosen]
        likelihood = None if residuals.estimated else _marginal_likelihood(residuals, radius, rng.spawn(1)[0], device)
        found = list(out[near])
        return cls(residuals, residuals, radius, features, centers, found, held, device, None, likelihood, parameters)

    def clean(self) -> Hyperparameters | None:
        """Return the belief of a scan so clean that its points tell their noise by themselves, or None.

        Its length is the shortest whose next is not better beyond its standard error. All that clean points tell asks
        for that; only where they, or a cube's features, are too few for it are longer ones clearly better.
        """
        left = self.residuals
        noise = clean_noise(left.points, left.normals, left.density, left.over, left.estimated)
        if noise is None:
            return None
        known = replace(self, known=noise)
        number, count = 0, len(self.parameters.lengths_disk_radii)
        while number + 1 < count and known._clearly_better(number + 1, number):
            number += 1
        return Hyperparameters(self._length(number), *noise)

    def choice(self) -> SelectedModel:
        """Return the belief that predicts best."""
        scores: dict[int, Float] = {}

        def least(number: int) -> float:
            """Return the least score of a length, over the noises."""
            if not 0 <= number < len(self.parameters.lengths_disk_radii):
                return np.inf
            scores[number] = self.scores(self._length(number))
            return float(scores[number].mean(axis=0).min())

        at = self.parameters.first_length_index
        step = 1 if least(at + 1) < least(at) else -1
        while least(at + step) < least(at):
            at += step
        count = len(_noise_candidates(self.parameters))
        tabled = {number: of_length[:, :count] for number, of_length in scores.items()}
        number, noise = _smoothest(tabled, parameters=self.parameters)
        most_likely = None
        if self.likelihood is not None:
            last, _ = _smoothest({number: of_length[:, -1:] for number, of_length in scores.items()})
            most_likely = self._belief(last, -1)
        return SelectedModel(self._belief(number, noise), tabled[number], most_likely)

    def _belief(self, number: int, noise: int) -> Hyperparameters:
        """Return the belief of the numbers of a length and of one of its noises."""
        length = self._length(number)
        return Hyperparameters(length, *self.noises(length)[noise])

    def _length(self, number: int) -> float:
        """Return a length scale, unit coordinates, by its number."""
        return self.parameters.lengths_disk_radii[number] * self.radius

    def _clearly_better(self, number: int, than: int) -> bool:
        """Return whether a length's score is better than another's by more than the standard error."""
        gain = self.scores(self._length(than))[:, 0] - self.scores(self._length(number))[:, 0]
        return bool(gain.mean() > gain.std() / np.sqrt(len(gain)))

    def noises(self, length: float) -> list[tuple[float, float]]:
        """Return the noises to try with a length, of positions and normals; that of most evidence is the last one.

        Unless they are known, points are taken to be no noisier than what is left over says.
        """
        if self.known is not None:
            return [self.known]
        if length not in self._noises:
            tried = [(position * self.radius, angle) for position, angle in _noise_candidates(self.parameters)]
            tried += [] if self.likelihood is None else [self.likelihood.noise(length)]
            most = max(self.residuals.over, self.parameters.least_position_noise_disk_radii * self.radius)
            self._noises[length] = [(min(position, most), angle) for position, angle in tried]
        return self._noises[length]

    def scores(self, length: float) -> Float:
        """Return the scores of a length, of shape (patches, noises), in radii; each length is tried once."""
        if length not in self._scored:
            self.noises(length)  # once, before the patches ask for them side by side
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
        rows = rows[~self.held[rows]]
        # Beyond this many the nearest tell enough, and time would grow with the length's square.
        most = self.parameters.most_patch_points
        if len(rows) > most:
            far = np.linalg.norm(self.residuals.points[rows] - center, axis=1)
            rows = rows[np.sort(np.argsort(far, kind="stable")[:most])]
        patch = self.residuals.patch(rows, center, Volume.none(), self.device)
        system = patch_system(patch, self.features, length, patch.size)
        target = self.told.patch(predicted, center, Volume.none(), self.device)
        normals = torch.as_tensor(self.told.normals[predicted], device=self.device)
        # Of a scan that is nearly exact, what is left over makes several noises one.
        noises = self.noises(length)
        found = {each: self._score(system.solve(*each), target, normals, length) for each in set(noises)}
        return [found[each] for each in noises]

    def _score(self, amplitudes: Tensor, target: Patch, normals: Tensor, length: float) -> float:
        value, gradient = self.features.sums(amplitudes, target.points, target.center, length, 1)
        # What is wanted less what is had: f + c and grad(f + c) - n, but for the sign.
        missing, turn = target.value - value, target.gradient - gradient
        slope = 1.0 - (turn * normals).sum(dim=1)
        if self.residuals.estimated and len(self.residuals) <= self.parameters.sparse_points:
            # Such normals are means of their neighbours', which a field that is too smooth predicts best. So distances
            # alone count, and a field that is steep because it winds through every point is not nearer for that.
            return float((missing.abs() / slope.clamp(self.parameters.least_slope, 1.0)).mean())
        distance = missing.abs() / slope.clamp_min(self.parameters.least_slope)
        return float(distance.mean() + self.radius * turn.norm(dim=1).mean())
