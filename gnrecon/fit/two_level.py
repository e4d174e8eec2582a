"""The default fit: a smooth global field, and local fields that correct it near the data.

The global field is a sine network that Gauss-Newton fits with an eikonal term, or a linear field. The local fields are
sums of sine features whose output weights solve linear least-squares problems. The steps, in the order of
`fit_two_level`:

1. Prepare the data: snap a ball, turn contradicted normals around, extend faces to sharp edges and across holes.
2. Fit the global field (`global_field`), without validation points; leave out outliers.
3. Apply the curvature penalties, if any, to the global field (`penalties`).
4. Choose length scale and noise on the validation points (`model_selection`).
5. Take the network's last steps on all points, if they are few. Then fit the local fields
   (`local_fields`), or those of a large scan by blocks (`blocks.solve`).
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gnrecon.field.partition_of_unity import Detail
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.fit.blocks.solve import fit_large, solve_by_blocks
from gnrecon.fit.blocks.workers import Workers, workers_for
from gnrecon.fit.consistency import find_outliers, flip_contradicted_normals
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.fit_summary import FitSummary, describe
from gnrecon.fit.global_field import FieldResiduals, GlobalField, fit_global
from gnrecon.fit.local_fields import PenaltiesFor, fit_detail
from gnrecon.fit.model_selection import select_hyperparameters
from gnrecon.fit.parameters import FitParameters
from gnrecon.fit.penalties.surface_penalties import FreeSpace, SurfacePenalties, penalise_global
from gnrecon.fit.shape_priors.ball_fit import BallFit
from gnrecon.fit.shape_priors.hole_completion import HoleCompletion, are_in_a_hole, complete_holes
from gnrecon.fit.shape_priors.prior_parameters import HoleCompletionParameters
from gnrecon.fit.shape_priors.sharp_shape import SharpShape
from gnrecon.geometry.arrays import Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.optim import Callback, Solution
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange


def fit_two_level(
    samples: Samples,
    options: FitOptions,
    rng: np.random.Generator,
    advance: ProgressCallback = ignore_progress,
    folder: str | Path | None = None,
    scheduler: str | None = None,
    callback: Callback | None = None,
    *,
    parameters: FitParameters = FitParameters(),
) -> tuple[NeuralSDF, Solution]:
    """Fit a global field and local fields.

    An interrupt (Ctrl-C) during the steps of Gauss-Newton, or while the local fields are solved, leaves the global
    field.

    Parameters
    ----------
    samples : points and normals in the unit ball
    options : choices of the fit
    rng : draws validation points, features and volume samples
    advance : called with the share that is done
    folder : where the work is kept; the local fields are then solved by blocks, as those of a large scan always are
    scheduler : address of a Dask scheduler that solves the blocks
    callback : called with the record of each step of Gauss-Newton

    Raises
    ------
    UsageError
        When curvature penalties are requested for a fit by blocks.
    FitError
        When a linear system cannot be solved.
    """
    by_blocks = folder is not None or len(samples) >= BlockParameters.large_scan_points
    if by_blocks and options.regularisers:
        raise UsageError(
            f"smooth, fill and prior are for fits of fewer than {BlockParameters.large_scan_points} points without a "
            "work folder; thin the scan with --max-points."
        )
    # By the number of points alone, so that the result does not depend on the number of threads.
    by_processes = by_blocks or len(samples) >= BlockParameters.process_points
    starting = by_processes and scheduler is None and not options.regularisers
    with workers_for(options.device) if starting else nullcontext() as workers:
        steps = _Steps(options, by_blocks, by_processes, rng, parameters, callback)
        share = parameters.two_level.global_time_share
        ball = steps.detect_ball(samples)
        data, flipped_share = steps.prepare(samples if ball is None else ball.samples)
        data, first, outliers = steps.fit_global(data, subrange(advance, 0.0, share))
        if first.solution.interrupted:
            status = f"{first.solution.status} This is the smooth global field alone."
            return first.sdf, replace(first.solution, status=status)
        sdf, penalties = steps.apply_penalties(first, data)
        try:
            rest = subrange(advance, share, 1.0)
            sdf, detail = steps.fit_local(first, sdf, data, penalties, outliers > 0, rest, folder, scheduler, workers)
        except KeyboardInterrupt:
            status = "Interrupted before the local fields were solved: this is the smooth global field alone."
            return sdf, replace(first.solution, status=status, interrupted=True)
    summary = replace(
        _summary(detail, data, options),
        flipped_share=flipped_share,
        outliers=outliers,
        steps=0 if first.ladder is None else len(first.solution.history),
        ball_radius=None if ball is None else ball.radius,
        ball_points=len(samples),
        ball_samples=0 if ball is None else len(ball.samples) - len(samples),
    )
    method = "Exact linear least squares." if first.ladder is None else first.solution.method
    solution = replace(first.solution, status=describe(summary), method=method)
    # Handles that they hold open are no noise of the field.
    across = data.across.points.astype(np.float32)
    return replace(sdf, detail=detail, support=across if len(across) else None), solution


@dataclass(frozen=True)
class _Data:
    """What the fields are fitted to.

    Parameters
    ----------
    scan : the points of the scan that are used
    samples : these, and samples that extend its faces to their edges and across holes
    held_out : mask of shape (N,), of the samples that the global field does not see: the validation points
    seen : rows of the samples that it sees
    sharp : the extended faces of a shape with sharp edges, or None
    across : samples that were added across holes
    """

    scan: Samples
    samples: Samples
    held_out: Mask
    seen: Int
    sharp: SharpShape | None
    across: HoleCompletion

    def across_holes(self, rng: np.random.Generator, parameters: HoleCompletionParameters) -> _Data:
        """Return the data with samples across the holes; a shape with sharp edges has them already."""
        if self.sharp is not None:
            return self
        exact = not self.samples.estimated
        across = complete_holes(self.samples.points, self.samples.normals, exact, parameters)
        if not len(across):
            return self
        held_out = np.concatenate([self.held_out, np.zeros(len(across), dtype=bool)])
        # The global field sees the same share of them as of the points that are not held out.
        share = len(self.seen) / max(len(self.samples) - int(self.held_out.sum()), 1)
        added = len(self.samples) + np.flatnonzero(rng.random(len(across)) < share)
        samples = self.samples.appended(across.points, across.normals)
        return _Data(self.scan, samples, held_out, np.concatenate([self.seen, added]), None, across)

    def without(self, outliers: Mask) -> _Data:
        """Return the data without some points of the scan, by a mask; its faces were not extended to their edges."""
        kept = ~np.concatenate([outliers, np.zeros(len(self.across), dtype=bool)])
        seen = np.flatnonzero(np.isin(np.flatnonzero(kept), self.seen))
        scan, samples = self.scan.select(~outliers), self.samples.select(kept)
        return _Data(scan, samples, self.held_out[kept], seen, None, self.across)


@dataclass(frozen=True)
class _Steps:
    """The steps of one fit, with what all of them need."""

    options: FitOptions
    by_blocks: bool
    by_processes: bool
    rng: np.random.Generator
    parameters: FitParameters
    callback: Callback | None = None

    @property
    def _finds_edges(self) -> bool:
        """Whether balls and sharp edges are looked for."""
        return not (self.by_blocks or self.options.regularisers)

    def detect_ball(self, samples: Samples) -> BallFit | None:
        """Return the samples snapped to a ball, or None of any other shape."""
        return BallFit.of(samples, self.parameters.ball) if self._finds_edges else None

    def prepare(self, scan: Samples) -> tuple[_Data, float]:
        """Return the data with faces extended to sharp edges, and the share of normals that were turned around."""
        priors = self.parameters.shape_priors
        sharp = SharpShape.of(scan, priors) if self._finds_edges and not scan.estimated else None
        data = self._draw(scan, sharp)
        if not scan.estimated:
            return data, 0.0
        scan, flipped_share = flip_contradicted_normals(scan, data.seen, self.options)
        sharp = SharpShape.of(scan, priors) if self._finds_edges else None
        data = replace(data, scan=scan, samples=scan) if sharp is None else self._draw(scan, sharp)
        return data, flipped_share

    def fit_global(self, data: _Data, advance: ProgressCallback) -> tuple[_Data, GlobalField, int]:
        """Return the completed data, the global field, and the number of outliers that were left out of both."""
        completed = self._completed(data)
        first = self._fit_global(completed, subrange(advance, 0.0, 0.5))
        # Of large scans, the distances of ingest have found the outliers.
        if self.by_blocks:
            return completed, first, 0
        density, limits = Density(data.scan.points), self.parameters.outliers
        # One field alone may miss a thin part; a point that no field explains is none of the surface.
        found = [find_outliers(value, density, parameters=limits) for value in first.values(data.scan)]
        outliers: Mask = np.logical_and.reduce(found)
        if first.solution.interrupted or not outliers.any():
            return completed, first, 0
        completed = self._without(outliers, data, completed)
        if first.ladder is None:
            # Robust weights have kept a network from them already, so that it need not be fitted again.
            first = self._fit_global(completed, subrange(advance, 0.5, 1.0))
        return completed, first, int(outliers.sum())

    def apply_penalties(self, first: GlobalField, data: _Data) -> tuple[NeuralSDF, PenaltiesFor | None]:
        """Return the global field after curvature penalties, and what gives those of a local length scale, if any."""
        regularisers = self.options.regularisers
        if not regularisers:
            return first.sdf, None
        density = Density(data.samples.points)
        free = FreeSpace.of(first.scene, self.rng)
        penalties = SurfacePenalties.of(regularisers, first.sdf, density, free, first.length, self.rng)
        bent = penalise_global(penalties, first.scene, self.options, self.rng)
        return bent, lambda length: SurfacePenalties.of(regularisers, bent, density, free, length, self.rng)

    def fit_local(
        self,
        first: GlobalField,
        sdf: NeuralSDF,
        data: _Data,
        penalties: PenaltiesFor | None,
        outliers: bool,
        advance: ProgressCallback,
        folder: str | Path | None,
        scheduler: str | None,
        workers: Workers | None,
    ) -> tuple[NeuralSDF, Detail]:
        """Return the global field and the local ones."""
        options, rng = self.options, self.rng
        if self.by_blocks:
            return sdf, fit_large(sdf, data.samples, data.held_out, options, rng, folder, advance, scheduler, workers)
        residuals = FieldResiduals.of(sdf, data.samples)
        if data.sharp is not None:
            hyperparameters = data.sharp.hyperparameters
        else:
            chosen = residuals, data.held_out, residuals.density.radius, rng, options.device
            hyperparameters = select_hyperparameters(*chosen, outliers=outliers)
            # The validation points have chosen everything, and may be fitted, too.
            if first.ladder is not None and len(residuals) <= self.parameters.two_level.most_refitted_points:
                sdf = first.refitted(data.samples)
                residuals = FieldResiduals.of(sdf, data.samples)
        cubes = self.parameters.local_fields
        advance(cubes.selection_time_share)
        fitted = (sdf, residuals, hyperparameters, options.features, rng, options.device, advance, penalties)
        by_processes = self.by_processes and options.device == "cpu"
        solve = partial(solve_by_blocks, workers=workers) if by_processes else None
        return sdf, fit_detail(*fitted, solve=solve, parameters=cubes)

    def _fit_global(self, completed: _Data, advance: ProgressCallback) -> GlobalField:
        """Return the global field that is fitted to completed data."""
        return fit_global(
            completed.samples,
            completed.held_out,
            completed.seen,
            self.options,
            self.rng,
            advance,
            self.callback,
            linear_only=not self.options.fits_network or completed.sharp is not None,
            parameters=self.parameters.global_field,
        )

    def _without(self, outliers: Mask, data: _Data, completed: _Data) -> _Data:
        """Return the completed data without outliers of the scan; `data` was there before its holes were completed."""
        scan, priors = data.scan, self.parameters.shape_priors
        if data.sharp is not None:
            rest = scan.select(~outliers)
            return self._completed(self._draw(rest, SharpShape.of(rest, priors)))
        left = completed.without(outliers)
        hidden = are_in_a_hole(scan.points[outliers], left.samples.points, left.samples.normals, priors.holes)
        return self._completed(data.without(outliers)) if hidden else left

    def _completed(self, data: _Data) -> _Data:
        """Return the data with samples across holes; a fit with curvature penalties closes holes by them."""
        if self.options.regularisers:
            return data
        return data.across_holes(self.rng, self.parameters.shape_priors.holes)

    def _draw(self, scan: Samples, sharp: SharpShape | None) -> _Data:
        """Draw the validation points and those that the global field sees."""
        limits = self.parameters.two_level
        samples = scan if sharp is None else sharp.samples
        order = self.rng.permutation(len(samples))
        # By blocks, validation points must lie so densely that those around a place describe that place alone.
        count = len(samples) // limits.validation_one_in
        count = count if self.by_blocks else min(count, limits.most_validation_points)
        held_out: Mask = np.zeros(len(samples), dtype=bool)
        held_out[order[:count]] = True
        seen = np.sort(order[count:][: limits.global_field_points])
        return _Data(scan, samples, held_out, seen, sharp, HoleCompletion.none() if sharp is None else sharp.holes)


def _summary(detail: Detail, data: _Data, options: FitOptions) -> FitSummary:
    """Return the part of the summary that the final data and the local fields determine."""
    chosen = detail.as_dict(data.scan.frame.scale)
    snapped = None if data.sharp is None else data.sharp.snapped
    averaging = None if data.sharp is None else data.sharp.averaging
    return FitSummary(
        cubes=detail.cubes,
        length=chosen["length"],
        position_noise=chosen["position_noise"],
        angle_noise=chosen["angle_noise"],
        shown_noise=None if data.scan.noise is None else data.scan.noise * data.scan.frame.scale,
        snapped_points=0 if snapped is None else int(snapped.on_primitive.sum()),
        primitives=0 if snapped is None else snapped.primitives,
        edge_samples=None if data.sharp is None else len(data.samples) - len(data.scan) - len(data.across),
        averaging_width=None if averaging is None else averaging.width_radii,
        hole_samples=len(data.across),
        holes=data.across.holes,
        regularisers=options.regularisers,
    )
