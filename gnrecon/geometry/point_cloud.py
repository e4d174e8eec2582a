"""Point clouds, the frame that maps them to the unit ball and back, and regions that select points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int, Mask, Values
from gnrecon.runtime.errors import InputError


def _as_rows(name: str, values: npt.ArrayLike) -> Float:
    rows = np.ascontiguousarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise InputError(f"{name} must have shape (N, 3), but have shape {rows.shape}.")
    return rows


@dataclass(frozen=True)
class PointCloud:
    """Points in the file's own frame and units.

    Parameters
    ----------
    points : array of shape (N, 3)
        Positions, kept in float64 so that projected (UTM-sized) coordinates stay exact.
    normals : array of shape (N, 3), optional
        Outward directions, not necessarily of unit length.
    attributes : mapping of name to array of shape (N,) or (N, C)
        Other values per point, such as colour, intensity and labels.
    origins : array of shape (N, 3), optional
        Position of the scanner that measured each point; rows of NaN where it is unknown.

    Raises
    ------
    InputError
        When array shapes do not match.
    """

    points: Float
    normals: Float | None = None
    attributes: Mapping[str, Values] = field(default_factory=dict)
    origins: Float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _as_rows("points", self.points))
        if self.normals is not None:
            object.__setattr__(self, "normals", _as_rows("normals", self.normals))
            if len(self.normals) != len(self.points):
                raise InputError(f"{len(self.points)} points cannot go with {len(self.normals)} normals.")
        if self.origins is not None:
            object.__setattr__(self, "origins", _as_rows("origins", self.origins))
            if len(self.origins) != len(self.points):
                raise InputError(f"{len(self.points)} points cannot go with {len(self.origins)} origins.")
        for name, values in self.attributes.items():
            if len(values) != len(self.points):
                raise InputError(f"{len(self.points)} points cannot go with {len(values)} values of {name!r}.")

    def __repr__(self) -> str:
        held = [*(["normals"] if self.normals is not None else []), *self.attributes]
        held += ["origins"] if self.origins is not None else []
        return f"<PointCloud: {len(self.points):,} points{''.join(f', {name}' for name in held)}>"

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: Mask | Int) -> PointCloud:
        """Return the cloud of the given rows (a mask of shape (N,), or indices), attributes included."""
        return PointCloud(
            self.points[rows],
            None if self.normals is None else self.normals[rows],
            {name: values[rows] for name, values in self.attributes.items()},
            None if self.origins is None else self.origins[rows],
        )

    @property
    def has_directions(self) -> bool:
        """Whether at least half of the points have a normal that is finite and not zero."""
        if self.normals is None:
            return False
        largest = np.abs(self.normals).max(axis=1, initial=0.0)
        return bool(2 * (np.isfinite(largest) & (largest > 0)).sum() >= len(self.points))

    def with_normals(self, normals: Float | None) -> PointCloud:
        """Return the same cloud with other normals, of shape (N, 3)."""
        return replace(self, normals=normals)


@dataclass(frozen=True)
class Frame:
    """The similarity between file coordinates x and unit coordinates u: ``x = center + scale * u``.

    The centre is the mean of the points and the scale the largest distance from it, as in the paper's experiments.

    Parameters
    ----------
    center : array of shape (3,), file units
    scale : float, file units per unit radius
    """

    center: Float
    scale: float

    @classmethod
    def of(cls, points: Float) -> Frame:
        """Return the frame that puts `points`, of shape (N, 3), into the unit ball around their mean.

        Raises
        ------
        InputError
            When all points coincide.
        """
        center = points.mean(axis=0)
        scale = float(np.linalg.norm(points - center, axis=1).max())
        if not scale > 0:
            raise InputError("All points coincide, so there is no surface to fit.")
        return cls(center, scale)

    def to_unit(self, points: Float) -> Float:
        """Map file coordinates, of shape (N, 3), to unit coordinates."""
        return (points - self.center) / self.scale

    def to_world(self, points: Float) -> Float:
        """Map unit coordinates, of shape (N, 3), to file coordinates."""
        return self.center + self.scale * points


@dataclass(frozen=True)
class Samples:
    """Input of a fit: positions in the unit ball with unit normals, and the frame that maps them back.

    Parameters
    ----------
    points : array of shape (N, 3), unit coordinates
    normals : array of shape (N, 3), outward, of length one
    frame : Frame
    held_out : Samples, optional
        Validation points, which the fit does not use, in the same frame.
    estimated : bool
        Whether the normals or their signs were estimated from the points and may be wrong in places.
    noise : float, optional
        Standard deviation of the points along the normal, unit coordinates, where it was measured.
    clean : bool, optional
        Whether the points have no noise that matters, where normals were estimated by it; see `spline_patches`.
    deviations : array of shape (N,), optional
        Standard deviations of estimated normals along each tangent, radians, where they are known.

    Raises
    ------
    InputError
        When there are not as many deviations as points.
    """

    points: Float
    normals: Float
    frame: Frame
    held_out: Samples | None = None
    estimated: bool = False
    noise: float | None = None
    clean: bool | None = None
    deviations: Float | None = None

    def __post_init__(self) -> None:
        if self.deviations is not None and len(self.deviations) != len(self.points):
            raise InputError(f"{len(self.points)} points cannot go with {len(self.deviations)} deviations.")

    def __repr__(self) -> str:
        held_out = "" if self.held_out is None else f", {len(self.held_out):,} held out"
        return f"<Samples: {len(self):,} points{held_out}, radius {self.frame.scale:.4g}>"

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: Mask | Int) -> Samples:
        """Return the samples of the given rows (a mask of shape (N,), or indices), with all else as it is."""
        deviations = None if self.deviations is None else self.deviations[rows]
        return replace(self, points=self.points[rows], normals=self.normals[rows], deviations=deviations)

    def replaced(self, points: Float, normals: Float) -> Samples:
        """Return other points and normals, of shape (N, 3), of the same scan, whose deviations are not known."""
        return replace(self, points=points, normals=normals, deviations=None)

    def appended(self, points: Float, normals: Float) -> Samples:
        """Return the samples with more of them, of shape (M, 3), whose normals are as sure as most."""
        deviations = self.deviations
        if deviations is not None:
            deviations = np.pad(deviations, (0, len(points)), constant_values=np.median(deviations))
        points, normals = np.concatenate([self.points, points]), np.concatenate([self.normals, normals])
        return replace(self, points=points, normals=normals, deviations=deviations)


BoxCorners = tuple[Sequence[float], Sequence[float]]


@dataclass(frozen=True)
class Region:
    """The part of space to keep: inside any of the boxes and on the positive side of all planes; in file units.

    Parameters
    ----------
    boxes : pairs of a lower and an upper corner, borders included; without boxes, all of space
    planes : rows of four numbers a, b, c, d; points with a x + b y + c z + d >= 0 are kept
    """

    boxes: tuple[BoxCorners, ...] = ()
    planes: tuple[Sequence[float], ...] = ()

    @property
    def everything(self) -> bool:
        """Whether it is all of space."""
        return not self.boxes and not self.planes

    def holds(self, points: Float) -> Mask:
        """Return the mask, of shape (N,), of points inside; points that are not finite count as inside."""
        inside = np.full(len(points), not self.boxes)
        for lower, upper in self.boxes:
            inside |= ~((points < np.asarray(lower)) | (points > np.asarray(upper))).any(axis=1)
        for *normal, offset in self.planes:
            with np.errstate(invalid="ignore", over="ignore"):
                inside &= ~(points @ np.asarray(normal) + offset < 0)
        return inside | ~np.isfinite(points).all(axis=1)
