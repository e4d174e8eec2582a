"""How well a mesh's triangles are shaped: their angles and the lengths of their edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.cloud import Float
from gnrecon.histogram import Histogram
from gnrecon.mesh import Mesh
from gnrecon.page.facts import Fact
from gnrecon.page.numbers import figure, share

NEEDLE = 10.0
"""Degrees: a triangle with a smaller angle is a needle, which simulations dislike."""


@dataclass(frozen=True)
class Quality:
    """Histograms of the angles (degrees) and of the edge lengths (file units), with figures of each."""

    angles: Histogram
    angle_figures: tuple[Fact, ...]
    edges: Histogram
    edge_figures: tuple[Fact, ...]


def quality(mesh: Mesh) -> Quality:
    """Measure every angle and every edge of a mesh with at least one face."""
    angles, lengths = corner_angles(mesh), edge_lengths(mesh)
    least = angles.min(axis=1)
    longest = float(np.percentile(lengths, 99.9)) or 1.0
    return Quality(
        Histogram.of(angles.reshape(-1), 0.0, 180.0, 60),
        (
            Fact("smallest", f"{figure(float(least.min()))}°"),
            Fact("mean smallest", f"{figure(float(least.mean()))}°", "of each triangle"),
            Fact("needles", share(float((least < NEEDLE).sum()), len(least)), f"below {NEEDLE:.0f}°"),
        ),
        Histogram.of(lengths, 0.0, longest, 56),
        (
            Fact("shortest", figure(float(lengths.min()))),
            Fact("mean", figure(float(lengths.mean()))),
            Fact("longest", figure(float(lengths.max()))),
        ),
    )


def corner_angles(mesh: Mesh) -> Float:
    """Return the angle at each corner of each face, of shape (F, 3), in degrees; zero where an edge has no length."""
    corners = mesh.corners
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    # The tangent's two parts stay exact for needles, where the cosine alone would not.
    sines = np.linalg.norm(np.cross(ahead, behind), axis=2)
    angles: Float = np.degrees(np.arctan2(sines, np.einsum("fki,fki->fk", ahead, behind)))
    return angles


def edge_lengths(mesh: Mesh) -> Float:
    """Return the length of each edge once, of shape (E,), in the mesh's units."""
    ends = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    # One number an edge sorts many times faster than a pair.
    once = np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1])
    start, end = np.divmod(once, len(mesh.vertices))
    lengths: Float = np.linalg.norm(mesh.vertices[end] - mesh.vertices[start], axis=1)
    return lengths
