"""How well a mesh's triangles are shaped: their angles and the lengths of their edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.export.quality import corner_angles, edge_lengths
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.statistics import Histogram
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
