"""What a mesh is, in numbers, and whether it bounds a solid.

A mesh is sound when it is not empty, every edge is shared by exactly two faces that walk it in opposite directions, the
faces around each vertex form one fan, its total volume is positive, and manifold3d takes it as a solid.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from gnrecon.export.solid import refusal, to_solid
from gnrecon.export.topology import Edges, face_components, split_vertices
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError


@dataclass(frozen=True)
class MeshFacts:
    """Counts and sizes of a mesh.

    Parameters
    ----------
    vertices, faces, components : int
        Vertices that faces use; faces; parts that share no vertex.
    euler_characteristic : int
        Vertices - edges + faces.
    genus : int or None
        Number of handles of all components together; None unless closed, manifold and oriented.
    area, volume : float
        In squared and cubed units of the vertices; the volume is signed, positive when the faces look outward.
    closed, manifold, oriented : bool
        No edge has a single face; no edge has more than two faces and no vertex several fans; every edge is walked as
        often one way as the other.
    degenerate_faces, boundary_edges, crowded_edges, turned_edges, split_vertices : int
        Faces that name a vertex twice; edges with one face; edges with more than two; edges whose two faces walk them
        the same way; vertices whose faces form several fans.
    """

    vertices: int
    faces: int
    components: int
    euler_characteristic: int
    genus: int | None
    area: float
    volume: float
    closed: bool
    manifold: bool
    oriented: bool
    degenerate_faces: int
    boundary_edges: int
    crowded_edges: int
    turned_edges: int
    split_vertices: int

    def as_dict(self) -> dict[str, object]:
        """All facts by name, ready for JSON."""
        return asdict(self)


def verify(mesh: Mesh) -> MeshFacts:
    """Count what there is to know about a mesh; nothing is required of it."""
    edges = Edges.of(mesh)
    pairs = edges.count == 2
    boundary, crowded = int((edges.count == 1).sum()), int((edges.count > 2).sum())
    turned = int((pairs & ~edges.balanced()).sum())
    split = len(split_vertices(mesh, edges))
    faces = mesh.faces
    degenerate = int(((faces == np.roll(faces, 1, axis=1)).any(axis=1)).sum())
    vertices = len(np.unique(faces))
    euler = vertices - len(edges.count) + len(faces)
    components = int(face_components(mesh).max(initial=-1)) + 1
    closed, manifold, oriented = boundary == 0, crowded == split == degenerate == 0, turned == 0
    return MeshFacts(
        vertices=vertices,
        faces=len(faces),
        components=components,
        euler_characteristic=euler,
        genus=components - euler // 2 if closed and manifold and oriented else None,
        area=mesh.area,
        volume=mesh.volume,
        closed=closed,
        manifold=manifold,
        oriented=oriented,
        degenerate_faces=degenerate,
        boundary_edges=boundary,
        crowded_edges=crowded,
        turned_edges=turned,
        split_vertices=split,
    )


def require_sound(mesh: Mesh) -> MeshFacts:
    """Return the facts of a mesh that bounds a solid.

    Raises
    ------
    MeshError
        Naming the first thing that is wrong.
    """
    facts = _facts_of_finite(mesh)
    failed = failures(facts)
    if not failed:
        error = refusal(to_solid(mesh, merge=False))
        failed = [f"is refused by manifold3d ({error})"] if error else []
    if failed:
        raise MeshError(f"The mesh {failed[0]}.")
    return facts


def require_bordered(mesh: Mesh) -> MeshFacts:
    """Return the facts of a mesh that may be open: an oriented edge-manifold, whose edges have one face or two.

    Raises
    ------
    MeshError
        Naming the first thing that is wrong.
    """
    facts = _facts_of_finite(mesh)
    failed = failures(facts, bordered=True)
    if failed:
        raise MeshError(f"The mesh {failed[0]}.")
    return facts


def verify_file(path: str | Path, bordered: bool = False) -> MeshFacts:
    """Read a mesh back from its file and require it to be sound, or bordered; STL corners are joined by position.

    Raises
    ------
    InputError
        When the file cannot be read.
    MeshError
        When what it holds is not as required; the sentence names the file.
    """
    from gnrecon.io import read_mesh

    try:
        return (require_bordered if bordered else require_sound)(read_mesh(Path(path)))
    except MeshError as error:
        raise MeshError(f"{path}, read back: {error}") from error


def _facts_of_finite(mesh: Mesh) -> MeshFacts:
    broken = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
    if broken:
        raise MeshError(f"The mesh has {broken} vertices that are not finite.")
    return verify(mesh)


def failures(facts: MeshFacts, bordered: bool = False) -> list[str]:
    """Say all that keeps a mesh from bounding a solid, or, where it may have borders, from being an edge-manifold.

    Each is the end of a sentence that begins with "The mesh".
    """
    solid = not bordered
    sentences = (
        (facts.faces == 0, "is empty"),
        (facts.degenerate_faces > 0, f"has {facts.degenerate_faces} faces that name a vertex twice"),
        (solid and not facts.closed, f"is open: {facts.boundary_edges} edges have only one face"),
        (facts.crowded_edges > 0, f"has {facts.crowded_edges} edges shared by more than two faces"),
        (facts.turned_edges > 0, f"is not consistently oriented: faces disagree across {facts.turned_edges} edges"),
        (solid and facts.split_vertices > 0, f"has {facts.split_vertices} vertices where several fans of faces touch"),
        (solid and facts.volume <= 0, f"is inside out: its volume is {facts.volume:.6g}"),
    )
    return [sentence for failed, sentence in sentences if failed]
