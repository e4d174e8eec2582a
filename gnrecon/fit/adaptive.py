"""The fit of any scan by default: a smooth global field, and detail that the data itself asks for.

Both are sine features with output weights that solve linear systems, one Gauss-Newton step each, which is exact because
the field is linear in them (variable projection). The global field, of at most `COARSE_POINTS` points and long
features, gives sign, free space and the closing of holes; it is kept smooth, because what it learned of the noise no
detail could take back. Some points are left out of it, on which length and noise of the detail are chosen (`choose`),
so that clean scans are interpolated and noisy ones smoothed, without a setting. Then the detail is solved (`detail`).
What is asked of the surface besides (`regulariser`) bends both, the global field before the detail.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gnrecon.advance import Advance, part, unheard
from gnrecon.cloud import Samples
from gnrecon.errors import UsageError
from gnrecon.fit.choose import Int, Mask
from gnrecon.fit.contradict import reconciled
from gnrecon.fit.detail import ShapingFor, fit_detail
from gnrecon.fit.global_field import GlobalField, fit_global
from gnrecon.fit.large import LARGE, fit_large
from gnrecon.fit.options import FitOptions
from gnrecon.fit.outlying import outlying
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.fit.shaped import Free, Shaping, bend_global
from gnrecon.optim import Solution
from gnrecon.sampling import Density

COARSE_POINTS = 5000
"""Most points that the global field sees."""

HELD_SHARE, HELD_MOST = 6, 2000
"""One point in so many is left out of the global field; up to so many where the detail is not solved by blocks."""

SHARE = 0.25
"""Share of the time after which the global field is there."""


def fit_adaptive(
    samples: Samples,
    options: FitOptions,
    rng: np.random.Generator,
    advance: Advance = unheard,
    folder: str | Path | None = None,
    scheduler: str | None = None,
) -> tuple[NeuralSDF, Solution]:
    """Fit a global field and its detail; `advance` is told of the share that is done.

    The detail of a large scan is solved by blocks (`large`), whose work is kept in a folder where one is given; then a
    Dask cluster can solve them, too.

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
    order = rng.permutation(len(samples))
    by_blocks = folder is not None or len(samples) >= LARGE
    if by_blocks and options.regularisers:
        raise UsageError(
            f"smooth, fill and prior are for fits of fewer than {LARGE} points without a work folder; "
            "thin the scan with --max-points."
        )
    # Left-out points must lie near each other, so that those around a place tell of it alone.
    out = len(samples) // HELD_SHARE if by_blocks else min(len(samples) // HELD_SHARE, HELD_MOST)
    held: Mask = np.zeros(len(samples), dtype=bool)
    held[order[:out]] = True
    rows: Int = np.sort(order[out:][:COARSE_POINTS])
    turned, left_out = 0.0, 0
    if samples.estimated:
        samples, turned = reconciled(samples, rows, options)
    first = fit_global(samples, held, rows, options, rng, part(advance, 0.0, SHARE / 2))
    if not by_blocks:  # of so many points, distances alone tell the outliers
        off = outlying(first.sdf.sdf(samples.frame.to_world(samples.points)), Density(samples.points))
        left_out = int(off.sum())
        if left_out:
            samples, held, rows = _without(off, samples, held, rows)
            first = fit_global(samples, held, rows, options, rng, part(advance, SHARE / 2, SHARE))
    sdf = first.sdf
    shape = None
    if options.regularisers:
        sdf, shape = _shaped(first, samples, options, rng)
    rest = part(advance, SHARE, 1.0)
    averaging = None
    try:
        if by_blocks:
            detail = fit_large(sdf, samples, held, options, rng, folder, rest, scheduler)
        else:
            detail, averaging = fit_detail(sdf, samples, held, options.features, rng, options.device, rest, shape)
    except KeyboardInterrupt:
        status = "Interrupted before the detail was solved: this is the smooth global field alone."
        return sdf, replace(first.solution, status=status, interrupted=True)
    chosen = detail.as_dict(samples.frame.scale)
    told = f" Turned {100 * turned:.2g} % of the normals around, which a first field contradicted." if turned else ""
    told += f" Left out {left_out} points that lie off the surface of their neighbours." if left_out else ""
    if averaging is not None:
        told += f" Averaged noisy points over {averaging.width:g} of their disks' radii, where normals agree."
    status = (
        f"Solved the global field and {chosen['cubes']} cubes of detail exactly; chosen from the data: features of "
        f"length {chosen['length']:.3g}, noise {chosen['position_noise']:.2g} in position and "
        f"{chosen['angle_noise']:.2g} degrees in normals.{told}{_asked(options)}"
    )
    return replace(sdf, detail=detail), replace(first.solution, status=status, method="Exact linear least squares.")


def _asked(options: FitOptions) -> str:
    """Return a sentence about what was asked of the surface besides, after a blank, or nothing."""
    asked = ", ".join(f"{one.name} ({one.weight:g})" for one in options.regularisers)
    return f" Asked of the surface besides, with its weight: {asked}." if asked else ""


def _without(off: Mask, samples: Samples, held: Mask, rows: Int) -> tuple[Samples, Mask, Int]:
    """Return what is left without some samples: the others, which of them are held out, and the rows of those seen."""
    kept = ~off
    seen = np.zeros(len(samples), dtype=bool)
    seen[rows] = True
    rest = replace(samples, points=samples.points[kept], normals=samples.normals[kept])
    return rest, held[kept], np.flatnonzero(seen[kept])


def _shaped(
    first: GlobalField, samples: Samples, options: FitOptions, rng: np.random.Generator
) -> tuple[NeuralSDF, ShapingFor]:
    """Return the global field bent to the regularisers, and how the detail is to heed them."""
    density, wanted = Density(samples.points), options.regularisers
    free = Free.of(first.scene, rng)
    bent = bend_global(Shaping.of(wanted, first.sdf, density, free, first.length, rng), first.scene, options, rng)
    return bent, lambda shorter: Shaping.of(wanted, bent, density, free, shorter, rng)
