"""A perspective camera that frames a shape from a named direction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.runtime.errors import UsageError

View = str | tuple[float, float]
"""A name of `VIEWS`, or the azimuth and elevation in degrees from which the shape is seen."""

VIEWS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "front": (0.0, 0.0),
        "right": (90.0, 0.0),
        "back": (180.0, 0.0),
        "left": (-90.0, 0.0),
        "top": (0.0, 89.9),
        "bottom": (0.0, -89.9),
        "three-quarter": (-35.0, 22.0),
    }
)

HALF_FIELD = float(np.tan(np.radians(12.0)))
"""Half the picture's shorter side at distance one: a field of view of 24 degrees, narrow enough to look undistorted."""

MARGIN = 0.92
"""Share of the picture that the shape may fill."""


@dataclass(frozen=True)
class Camera:
    """Where the eye is and what a pixel looks at.

    Parameters
    ----------
    eye : array of shape (3,)
    axes : array of shape (3, 3)
        Rows: right, up, and backward, towards the eye.
    width, height : int
        Of the picture in pixels.
    """

    eye: Float
    axes: Float
    width: int
    height: int

    @property
    def focal(self) -> float:
        """Pixels per unit of slope."""
        return min(self.width, self.height) / (2 * HALF_FIELD)

    @classmethod
    def framing(cls, points: Float, view: View, up: str, width: int, height: int) -> Camera:
        """Return the camera that sees all `points`, of shape (N, 3), as large as possible.

        Raises
        ------
        UsageError
            When the view or the upward axis is unknown.
        """
        axes = _axes(view, up)
        right, upward, backward = axes @ points.T
        slopes = np.array([width, height]) / min(width, height) * HALF_FIELD * MARGIN
        # A point (x, y, z) is in the picture when |x - x0| <= s (d - z): each side is a plane, so the eye's distance d
        # and its offset x0 follow from the two extreme planes of the wider direction.
        planes = [
            (np.max(x / s + backward), np.max(-x / s + backward)) for x, s in zip((right, upward), slopes, strict=True)
        ]
        distance = max((high + low) / 2 for high, low in planes)
        offsets = [s * (high - low) / 2 for (high, low), s in zip(planes, slopes, strict=True)]
        return cls(np.array([*offsets, distance]) @ axes, axes, width, height)

    def rays(self) -> Float:
        """Origins and unit directions through the pixels' middles, of shape (height, width, 6)."""
        x = (np.arange(self.width) + 0.5 - self.width / 2) / self.focal
        y = (self.height / 2 - np.arange(self.height) - 0.5) / self.focal
        rays = np.empty((self.height, self.width, 6))
        rays[..., :3] = self.eye
        rays[..., 3:] = x[None, :, None] * self.axes[0] + y[:, None, None] * self.axes[1] - self.axes[2]
        rays[..., 3:] /= np.linalg.norm(rays[..., 3:], axis=2, keepdims=True)
        return rays

    def project(self, points: Float) -> tuple[Float, Float, Float]:
        """Column, row and depth, each of shape (N,), at which points of shape (N, 3) appear."""
        x, y, z = self.axes @ (points - self.eye).T
        return self.width / 2 - self.focal * x / z, self.height / 2 + self.focal * y / z, -z


def _axes(view: View, up: str) -> Float:
    """Right, up and backward directions, as rows, of the camera that looks from a view."""
    if isinstance(view, str) and view not in VIEWS:
        raise UsageError(f"The view {view!r} is unknown; expected one of {', '.join(VIEWS)}, or azimuth and elevation.")
    if up not in ("y", "z"):
        raise UsageError(f"The upward axis is {up!r}, but must be 'y' or 'z'.")
    azimuth, elevation = np.radians(VIEWS[view] if isinstance(view, str) else view)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    # With z upward, the front is seen from -y; with y upward, from +z.
    axes = np.array([[ca, sa, 0], [sa * -se * -1, -ca * -se * -1, ce], [sa * ce, -ca * ce, se]])
    axes[1] = np.cross(axes[2], axes[0])
    return axes if up == "z" else axes[:, [0, 2, 1]] * np.array([1, 1, -1])
