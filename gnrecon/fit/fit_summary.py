"""What the default fit did, as numbers (`FitSummary`) and as sentences for the user (`describe`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from gnrecon.fit.penalties.regularisers import Regulariser


@dataclass(frozen=True)
class FitSummary:
    """What was done in a fit of a global field and local fields.

    Parameters
    ----------
    cubes : number of local fields
    length : median length scale of the local features, file units
    position_noise : of the points, file units
    angle_noise : of the normals, degrees
    shown_noise : that the points themselves show, file units, or None where it is unknown or was smoothed away
    flipped_share : share of the normals that were turned around, in [0, 1]
    outliers : points that were left out
    averaging_width : of the bilateral filter, in disk radii, or None where points were not averaged
    ball_radius : of the ball that all points were snapped to, file units, or None
    ball_points, ball_samples : points that were snapped to it, and samples that fill its gaps
    snapped_points, primitives : points that were snapped to planes, cylinders and spheres, and how many of those
    edge_samples : samples that extend faces to their sharp edges, or None of a shape without sharp edges
    hole_samples, holes : samples that extend planes and cylinders across holes, and the number of holes
    regularisers : curvature penalties that were applied
    steps : of Gauss-Newton that made the global field, or none of a linear one
    """

    cubes: int
    length: float
    position_noise: float
    angle_noise: float
    shown_noise: float | None = None
    flipped_share: float = 0.0
    outliers: int = 0
    averaging_width: float | None = None
    ball_radius: float | None = None
    ball_points: int = 0
    ball_samples: int = 0
    snapped_points: int = 0
    primitives: int = 0
    edge_samples: int | None = None
    hole_samples: int = 0
    holes: int = 0
    regularisers: tuple[Regulariser, ...] = ()
    steps: int = 0


def describe(summary: FitSummary) -> str:
    """Return what was done, one short sentence for each step that did something."""
    return " ".join([*_solved(summary), *_changed_data(summary), *_added_data(summary), *_penalised(summary)])


def _solved(summary: FitSummary, *, least_unused_degrees: float = 45.0) -> Iterator[str]:
    by_steps = f" by {_counted(summary.steps, 'Gauss-Newton step')}," if summary.steps else ""
    yield f"Fitted a global field{by_steps} and {_counted(summary.cubes, 'local field')} by linear least squares."
    if summary.edge_samples is None:
        normals = f" and {summary.angle_noise:.2g} degrees in normals"
        if summary.angle_noise > least_unused_degrees:
            normals = "; estimated normals say which side is outside"
        noise = f"noise {summary.position_noise:.2g} in position{normals}"
        yield f"Chosen from the data: length scale {summary.length:.3g}, {noise}."
        yield from _disagreement(summary)
    else:
        yield f"The length scale is {summary.length:.3g}, the shortest that the samples of sharp faces allow."


def _disagreement(summary: FitSummary, *, notable_factor: float = 3.0) -> Iterator[str]:
    """Yield a sentence where the noise that the fit assumes is far from the noise that the points show."""
    shown, assumed = summary.shown_noise, summary.position_noise
    if not shown or summary.averaging_width is not None or shown / notable_factor <= assumed <= shown * notable_factor:
        return
    way = "smooths more" if assumed > shown else "follows the points more closely"
    yield f"Their spread about quadrics suggests a noise of {shown:.2g} in position; the fit {way}."


def _changed_data(summary: FitSummary) -> Iterator[str]:
    if summary.flipped_share:
        yield f"Turned {100 * summary.flipped_share:.2g} % of the normals around: a first field contradicts them."
    if summary.outliers:
        yield f"Left out {_counted(summary.outliers, 'outlier')}."
    if summary.averaging_width is not None:
        yield f"Averaged noisy points over {summary.averaging_width:g} disk radii where their normals agree."
    if summary.ball_radius is not None:
        yield f"Snapped {_counted(summary.ball_points, 'point')} to a ball of radius {summary.ball_radius:.6g}."
        if summary.ball_samples:
            yield f"Filled gaps of the ball with {_counted(summary.ball_samples, 'sample')}."
    if summary.snapped_points:
        surfaces = "detected planes, cylinders and spheres"
        yield f"Snapped {_counted(summary.snapped_points, 'point')} to {summary.primitives:,} {surfaces}."


def _added_data(summary: FitSummary) -> Iterator[str]:
    if summary.edge_samples:
        yield f"Extended faces to their sharp edges with {_counted(summary.edge_samples, 'sample')}."
    if summary.holes:
        samples, holes = _counted(summary.hole_samples, "sample"), _counted(summary.holes, "hole")
        yield f"Extended planes and cylinders across {holes} with {samples}."


def _penalised(summary: FitSummary) -> Iterator[str]:
    if summary.regularisers:
        names = ", ".join(f"{one.name} (weight {one.weight:g})" for one in summary.regularisers)
        yield f"Applied curvature penalties: {names}."


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}" + ("" if count == 1 else "s")
