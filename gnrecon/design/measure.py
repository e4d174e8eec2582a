"""How well a part keeps to its design: what of it is outside of the region, how far interfaces are, in how many pieces.

All lengths are in half the region's longest side. Interfaces of holes lie on the region's own border, and a part that
is attached to them does, so that `violations` counts what is farther outside than a tolerance.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from gnrecon.design.design import Design
from gnrecon.export.mesh_statistics import face_components, submesh
from gnrecon.export.metrics import nearest_on_surface, sample_surface
from gnrecon.geometry.mesh import Mesh

TOLERANCE = 1e-3
_SAMPLES = 50_000
_ON_EACH = 2000


@dataclass(frozen=True)
class DesignFacts:
    """What a part's mesh is, against its design.

    Parameters
    ----------
    violations : share of its surface that lies farther than `TOLERANCE` outside of the region
    depth : how far its farthest sampled point lies outside; 0 when none does
    attachment : mean distance from the surface of the points of each interface
    components : solid pieces; cavities within them do not count
    """

    violations: float
    depth: float
    attachment: tuple[float, ...]
    components: int

    @property
    def mean_attachment(self) -> float:
        """Mean distance of all interfaces, each of the same weight."""
        return float(np.mean(self.attachment))

    def describe(self) -> str:
        """Say the facts in a sentence."""
        away = ", ".join(f"{distance:.1e}" for distance in self.attachment)
        pieces = "1 piece" if self.components == 1 else f"{self.components} pieces"
        return (
            f"{pieces}; {self.violations:.2%} of the surface is outside of the design region, by {self.depth:.3g} at "
            f"most; the interfaces are {away} away (lengths in half the region's longest side)."
        )

    def as_dict(self) -> dict[str, object]:
        """Return the facts as plain values."""
        return {**asdict(self), "attachment": list(self.attachment), "mean_attachment": self.mean_attachment}


def judge(mesh: Mesh, design: Design, rng: np.random.Generator) -> DesignFacts:
    """Measure a part.

    Parameters
    ----------
    mesh : closed, in the coordinates of the region's file
    rng : draws 50,000 points of its surface and 2,000 of each interface
    """
    part = mesh.with_vertices(design.frame.to_unit(mesh.vertices))
    outside = design.region.distance(sample_surface(part, _SAMPLES, rng).points)
    walls = design.interfaces.sample(_ON_EACH * len(design.interfaces), rng)
    away = nearest_on_surface(part, walls.points)[0]
    return DesignFacts(
        float((outside > TOLERANCE).mean()),
        max(0.0, float(outside.max())),
        tuple(float(away[walls.pieces == piece].mean()) for piece in range(len(design.interfaces))),
        solid_pieces(part),
    )


def solid_pieces(mesh: Mesh) -> int:
    """Return the number of solids that a closed, outward oriented mesh bounds: components that are no cavities."""
    labels = face_components(mesh)
    return sum(submesh(mesh, labels == label).volume > 0 for label in range(labels.max(initial=-1) + 1))
