"""The fit of any scan by default: a smooth global field, and detail that the data itself asks for.

Both are sine features with output weights that solve linear systems, one Gauss-Newton step each, which is exact because
the field is linear in them (variable projection). The global field, of at most `COARSE_POINTS` points and long
features, gives sign, free space and the closing of holes; it is kept smooth, because what it learned of the noise no
detail could take back. Some points are left out of it, on which length and noise of the detail are chosen (`choose`),
so that clean scans are interpolated and noisy ones smoothed, without a setting. Then the detail is solved (`detail`).
What is asked of the surface besides (`regulariser`) bends both, the global field before the detail.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.fit.blocks.solve import fit_large
from gnrecon.fit.consistency import outlying, reconciled
from gnrecon.fit.denoising import Told, told
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.global_field import GlobalField, fit_global
from gnrecon.fit.local_fields import CHOSEN, ShapingFor, fit_detail
from gnrecon.fit.regularised import Free, Shaping, bend_global
from gnrecon.fit.shape_priors.ball_fit import BallFit
from gnrecon.fit.shape_priors.hole_completion import HoleCompletion, complete_holes
from gnrecon.fit.shape_priors.sharp_shape import SharpShape
from gnrecon.geometry.arrays import Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.optim import Solution
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, part

COARSE_POINTS = 5000
"""Most points that the global field sees."""

HELD_SHARE, HELD_MOST = 6, 2000
"""One point in so many is left out of the global field; up to so many where the detail is not solved by blocks."""

SHARE = 0.25
"""Share of the time after which the global field is there."""


@dataclass(frozen=True)
class _Task:
    """What is fitted.

    Parameters
    ----------
    samples : of the scan, and those that continue its faces to their edges and across holes
    held : mask of shape (N,), of samples that the global field does not see
    rows : of those that it sees
    sharp : the faces, where they are continued to their edges
    across : samples that were added across holes
    """

    samples: Samples
    held: Mask
    rows: Int
    sharp: SharpShape | None
    across: HoleCompletion

    @classmethod
    def of(cls, samples: Samples, sharp: SharpShape | None, by_blocks: bool, rng: np.random.Generator) -> _Task:
        """Draw what is held out of a scan, whose faces may be continued."""
        if sharp is not None:
            samples = sharp.samples
        order = rng.permutation(len(samples))
        # Left-out points must lie near each other, so that those around a place tell of it alone.
        out = len(samples) // HELD_SHARE if by_blocks else min(len(samples) // HELD_SHARE, HELD_MOST)
        held: Mask = np.zeros(len(samples), dtype=bool)
        held[order[:out]] = True
        across = HoleCompletion.none() if sharp is None else sharp.holes
        return cls(samples, held, np.sort(order[out:][:COARSE_POINTS]), sharp, across)

    def continued(self, rng: np.random.Generator) -> _Task:
        """Return the task with samples across the holes; a scan whose faces are continued to their edges has them."""
        if self.sharp:
            return self
        across = complete_holes(self.samples.points, self.samples.normals, not self.samples.estimated)
        if not len(across):
            return self
        points, normals = across.appended_to(self.samples.points, self.samples.normals)
        held = np.concatenate([self.held, np.zeros(len(across), dtype=bool)])
        # As many of them as of the points that are not held out.
        share = len(self.rows) / max(len(self.samples) - int(self.held.sum()), 1)
        seen = len(self.samples) + np.flatnonzero(rng.random(len(across)) < share)
        rows = np.concatenate([self.rows, seen])
        return _Task(replace(self.samples, points=points, normals=normals), held, rows, None, across)

    def without(self, off: Mask) -> _Task:
        """Return what is left without some samples, of a scan whose faces are not continued."""
        kept = ~off
        seen = np.zeros(len(off), dtype=bool)
        seen[self.rows] = True
        rest = replace(self.samples, points=self.samples.points[kept], normals=self.samples.normals[kept])
        return _Task(rest, self.held[kept], np.flatnonzero(seen[kept]), None, HoleCompletion.none())

    def told(self, sdf: NeuralSDF, options: FitOptions, rng: np.random.Generator, outliers: bool) -> Told:
        """Return what the samples tell beside a global field; `outliers` says whether some were found among them."""
        if self.sharp is not None:
            return Told.of_faces(sdf, self.sharp)
        return told(sdf, self.samples, self.held, options.features, rng, options.device, outliers)


def fit_adaptive(
    samples: Samples,
    options: FitOptions,
    rng: np.random.Generator,
    advance: ProgressCallback = ignore_progress,
    folder: str | Path | None = None,
    scheduler: str | None = None,
) -> tuple[NeuralSDF, Solution]:
    """Fit a global field and its detail; `advance` is told of the share that is done.

    The detail of a large scan is solved by blocks (`large`), whose work is kept in a folder where one is given; then a
    Dask cluster can solve them, too.

    The points of a ball are laid on it first (`ball`), and the faces of a sharp shape are continued to their edges
    (`sharp`), planes and cylinders of any across its holes (`holes`).

    Normals that were estimated are turned around where a first field contradicts them, and points that lie off the
    surface of their neighbours are left out.

    An interrupt (Ctrl-C) while the detail is solved leaves the global field.

    Raises
    ------
    UsageError
        When regularisers are asked for of a fit by blocks.
    FitError
        When a linear system cannot be solved.
    """
    by_blocks = folder is not None or len(samples) >= BlockParameters.large_scan_points
    if by_blocks and options.regularisers:
        raise UsageError(
            f"smooth, fill and prior are for fits of fewer than {BlockParameters.large_scan_points} points without a work folder; "
            "thin the scan with --max-points."
        )
    edges = not (by_blocks or options.regularisers)
    ball = BallFit.of(samples) if edges else None
    scanned = len(samples)
    samples = samples if ball is None else ball.samples
    sharp = SharpShape.of(samples) if edges and not samples.estimated else None
    task = _Task.of(samples, sharp, by_blocks, rng)
    turned, left_out = 0.0, 0
    if samples.estimated:
        samples, turned = reconciled(samples, task.rows, options)
        sharp = SharpShape.of(samples) if edges else None
        task = replace(task, samples=samples) if sharp is None else _Task.of(samples, sharp, by_blocks, rng)
    whole = task
    closes = not options.regularisers  # which say themselves how holes are closed
    task = task.continued(rng) if closes else task
    first = fit_global(task.samples, task.held, task.rows, options, rng, part(advance, 0.0, SHARE / 2))
    if not by_blocks:  # of so many points, distances alone tell the outliers
        off = outlying(first.sdf.sdf(samples.frame.to_world(samples.points)), Density(samples.points))
        left_out = int(off.sum())
        if left_out:
            samples = replace(samples, points=samples.points[~off], normals=samples.normals[~off])
            task = _Task.of(samples, SharpShape.of(samples), by_blocks, rng) if task.sharp else whole.without(off)
            task = task.continued(rng) if closes else task
            first = fit_global(task.samples, task.held, task.rows, options, rng, part(advance, SHARE / 2, SHARE))
    sdf = first.sdf
    shape = None
    if options.regularisers:
        sdf, shape = _shaped(first, task.samples, options, rng)
    rest = part(advance, SHARE, 1.0)
    known = None
    try:
        if by_blocks:
            detail = fit_large(sdf, task.samples, task.held, options, rng, folder, rest, scheduler)
        else:
            known = task.told(sdf, options, rng, left_out > 0)
            rest(CHOSEN)
            detail = fit_detail(sdf, known, options.features, rng, options.device, rest, shape)
    except KeyboardInterrupt:
        status = "Interrupted before the detail was solved: this is the smooth global field alone."
        return sdf, replace(first.solution, status=status, interrupted=True)
    chosen = detail.as_dict(samples.frame.scale)
    also = f" Turned {100 * turned:.2g} % of the normals around, which a first field contradicted." if turned else ""
    also += f" Left out {left_out} points that lie off the surface of their neighbours." if left_out else ""
    if known is not None and known.averaging is not None:
        also += (
            f" Averaged noisy points over {known.averaging.width_radii:g} of their disks' radii, where normals agree."
        )
    if ball is not None:
        also += (
            f" Laid {scanned} points on a ball of radius {ball.radius:.6g}, from which their noise cannot tell them, "
            f"and filled its gaps by {len(ball.samples) - scanned} samples."
        )
    if task.sharp is not None:
        also += _laid(task.sharp)
        also += f" Continued faces to their edges by {len(task.samples) - len(samples) - len(task.across)} samples."
    if task.across.holes:
        also += f" Continued planes and cylinders across {_holes(task.across.holes)} by {len(task.across)} samples."
    if task.sharp is None:
        beside = f"noise {chosen['position_noise']:.2g} in position and {chosen['angle_noise']:.2g} degrees in normals"
    else:
        beside = "as short as its sharp faces can tell apart"
    status = (
        f"Solved the global field and {chosen['cubes']} cubes of detail exactly; chosen from the data: features of "
        f"length {chosen['length']:.3g}, {beside}.{also}{_asked(options)}"
    )
    return replace(sdf, detail=detail), replace(first.solution, status=status, method="Exact linear least squares.")


def _laid(sharp: SharpShape) -> str:
    """Return a sentence about points that were laid on surfaces, after a blank, or nothing."""
    if sharp.snapped is None:
        return ""
    laid = sharp.snapped
    return (
        f" Laid {int(laid.snapped.sum())} points on {laid.primitives} planes, cylinders and spheres, "
        "from which the noise cannot tell them."
    )


def _holes(count: int) -> str:
    return "one hole" if count == 1 else f"{count} holes"


def _asked(options: FitOptions) -> str:
    """Return a sentence about what was asked of the surface besides, after a blank, or nothing."""
    asked = ", ".join(f"{one.name} ({one.weight:g})" for one in options.regularisers)
    return f" Asked of the surface besides, with its weight: {asked}." if asked else ""


def _shaped(
    first: GlobalField, samples: Samples, options: FitOptions, rng: np.random.Generator
) -> tuple[NeuralSDF, ShapingFor]:
    """Return the global field bent to the regularisers, and how the detail is to heed them."""
    density, wanted = Density(samples.points), options.regularisers
    free = Free.of(first.scene, rng)
    bent = bend_global(Shaping.of(wanted, first.sdf, density, free, first.length, rng), first.scene, options, rng)
    return bent, lambda shorter: Shaping.of(wanted, bent, density, free, shorter, rng)
