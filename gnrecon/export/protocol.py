"""What the exporter needs to know of a field: a signed distance with its gradient, in the file's coordinates."""

from __future__ import annotations

from typing import Protocol

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame


class SignedDistance(Protocol):
    """A scalar field whose zero level is the surface; a fitted network, or any function with these four members."""

    @property
    def frame(self) -> Frame:
        """The similarity between file coordinates and the unit ball around the shape."""
        ...

    @property
    def bounds(self) -> Float:
        """Lower and upper corner, of shape (2, 3) and in file units, of the box within which the field is trusted."""
        ...

    def sdf(self, points: Float) -> Float:
        """Signed distance in file units, of shape (N,), negative inside, at file coordinates of shape (N, 3)."""
        ...

    def gradient(self, points: Float) -> Float:
        """Gradient of the distance, of shape (N, 3) and without unit, at file coordinates of shape (N, 3)."""
        ...


def sdf_and_gradient(field: SignedDistance, points: Float) -> tuple[Float, Float]:
    """Return the distance, of shape (N,), and its gradient, of shape (N, 3), at points, of shape (N, 3).

    A field that can make both at once, by a method of this name, does: it costs about half.
    """
    both = getattr(field, "sdf_and_gradient", None)
    if both is None:
        return field.sdf(points), field.gradient(points)
    value, gradient = both(points)
    return value, gradient


def knows_blocks(field: SignedDistance) -> bool:
    """Return whether a field makes distances around centres faster than one by one, by a method ``sdf_around``."""
    return hasattr(field, "sdf_around")


def sdf_around(field: SignedDistance, centers: Float, offsets: Float) -> Float:
    """Return the distance, of shape (N, K), at K offsets, of shape (K, 3), from each of the centres, of shape (N, 3).

    A field that knows blocks, see `knows_blocks`, is asked for them.
    """
    around = getattr(field, "sdf_around", None)
    if around is None:
        return field.sdf((centers[:, None] + offsets).reshape(-1, 3)).reshape(len(centers), len(offsets))
    values: Float = around(centers, offsets)
    return values
