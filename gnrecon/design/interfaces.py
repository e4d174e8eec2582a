"""Interfaces: pieces of surface that a part must contain, with the normals that it must have there.

They come as one mesh of separate pieces, such as the walls of bolt holes. Their faces look out of the part, as those of
a part do: into the hole.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from gnrecon.export.mesh_statistics import face_components, submesh
from gnrecon.export.metrics import sample_surface
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh


class InterfaceSample(NamedTuple):
    """Points on interfaces.

    Parameters
    ----------
    points : of shape (N, 3)
    normals : unit, out of the part, of shape (N, 3)
    pieces : number of the interface that each belongs to, of shape (N,)
    """

    points: Float
    normals: Float
    pieces: Int


class Interfaces:
    """The interfaces of a part.

    Parameters
    ----------
    mesh : Mesh
        Unit coordinates; open, one connected piece for each interface.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    @cached_property
    def pieces(self) -> list[Mesh]:
        """One mesh for each interface, in the order of their first faces."""
        labels = face_components(self.mesh)
        return [submesh(self.mesh, labels == label) for label in range(labels.max() + 1)]

    def __len__(self) -> int:
        return len(self.pieces)

    def sample(self, count: int, rng: np.random.Generator) -> InterfaceSample:
        """Draw about `count` points, as many on each interface: a small one is held as firmly as a large one."""
        each = max(1, round(count / len(self)))
        drawn = [sample_surface(piece, each, rng) for piece in self.pieces]
        normals = [sample.normals for sample in drawn if sample.normals is not None]
        numbers = np.repeat(np.arange(len(self)), each)
        return InterfaceSample(np.concatenate([sample.points for sample in drawn]), np.concatenate(normals), numbers)
