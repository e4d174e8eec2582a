"""Counts and sizes of a mesh, and whether it bounds a solid.

A mesh is sound when it is not empty, every edge is shared by exactly two faces that walk it in opposite directions, the
faces around each vertex form one fan, its total volume is positive, and manifold3d accepts it as a solid.
`verify` counts, `require_sound` requires, and `examine` also lists what a sound mesh may have but some uses forbid:
faces that intersect or repeat others or have no area, vertices that coincide or that no face uses.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from gnrecon.export.boolean import manifold_error, to_meshlab, to_solid
from gnrecon.export.mesh_statistics import Edges, face_components, split_vertices
from gnrecon.geometry.arrays import Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError


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
    """Count and measure any mesh; nothing is required of it."""
    edges = Edges.of(mesh)
    pairs = edges.count == 2
    boundary, crowded = int((edges.count == 1).sum()), int((edges.count > 2).sum())
    turned = int((pairs & ~edges.balanced()).sum())
    split = len(split_vertices(mesh, edges))
    degenerate = int(_names_twice(mesh).sum())
    vertices = len(np.unique(mesh.faces))
    euler = vertices - len(edges.count) + len(mesh.faces)
    components = int(face_components(mesh).max(initial=-1)) + 1
    # For closed, oriented 2-manifolds, V - E + F = 2 (components - genus).
    closed, manifold, oriented = boundary == 0, crowded == split == degenerate == 0, turned == 0
    return MeshFacts(
        vertices=vertices,
        faces=len(mesh.faces),
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
        Naming the first defect.
    """
    facts = _facts_of_finite(mesh)
    failed = failures(facts)
    if not failed:
        error = manifold_error(to_solid(mesh, merge=False))
        failed = [f"is refused by manifold3d ({error})"] if error else []
    if failed:
        raise MeshError(f"The mesh {failed[0]}.")
    return facts


def require_bordered(mesh: Mesh) -> MeshFacts:
    """Return the facts of a mesh that may be open: an oriented edge-manifold, whose edges have one face or two.

    Raises
    ------
    MeshError
        Naming the first defect.
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
    """List what keeps a mesh from bounding a solid, or, where it may have borders, from being an edge-manifold.

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


@dataclass(frozen=True)
class Findings:
    """Defects and oddities of a mesh.

    Parameters
    ----------
    facts : MeshFacts
    failures : tuple of str
        What keeps it from bounding a solid, as ends of a sentence that begins with "The mesh"; empty if it does.
    broken_vertices : int
        With coordinates that are not finite.
    unused_vertices : int
        That no face names.
    coincident_vertices : int
        At exactly the place of an earlier one.
    repeated_faces : int
        With the same three vertices as an earlier one, in whatever order.
    flat_faces : int
        Of three different vertices whose triangle has no area beyond rounding.
    self_intersecting_faces : int or None
        That pass through another face; None where vertices are not finite, or pymeshlab is not installed.
    """

    facts: MeshFacts
    failures: tuple[str, ...]
    broken_vertices: int
    unused_vertices: int
    coincident_vertices: int
    repeated_faces: int
    flat_faces: int
    self_intersecting_faces: int | None

    @property
    def sound(self) -> bool:
        """Whether the mesh is a non-empty, closed, oriented 2-manifold around a positive volume."""
        return not self.failures

    def as_dict(self) -> dict[str, object]:
        """All findings by name, ready for JSON."""
        counts = {name: getattr(self, name) for name in _COUNTS}
        return {"sound": self.sound, "failures": list(self.failures), **self.facts.as_dict(), **counts}

    def describe(self) -> list[str]:
        """One line for each finding: its name, its value, and what it means."""
        values = self.as_dict()
        return [
            f"{name:24}{_shown(values[name]):>14}  {meaning}".rstrip()
            for name, meaning in {**_FACTS, **_COUNTS}.items()
        ]


def examine(mesh: Mesh) -> Findings:
    """Find all defects of any mesh; nothing is changed."""
    broken = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
    # Infinite and missing coordinates are a finding here, not an error.
    with np.errstate(invalid="ignore", over="ignore"):
        facts = verify(mesh)
        flat = _flat_faces(mesh)
    failed = failures(facts)
    if broken:
        failed = [f"has {broken} vertices that are not finite", *failed]
    if not failed and (error := manifold_error(to_solid(mesh, merge=False))):
        failed = [f"is refused by manifold3d ({error})"]
    return Findings(
        facts=facts,
        failures=tuple(failed),
        broken_vertices=broken,
        unused_vertices=len(mesh.vertices) - facts.vertices,
        coincident_vertices=len(mesh.vertices) - len(np.unique(mesh.vertices, axis=0)),
        repeated_faces=facts.faces - len(np.unique(np.sort(mesh.faces, axis=1), axis=0)),
        flat_faces=flat,
        self_intersecting_faces=None if broken else self_intersecting_faces(mesh),
    )


def self_intersecting_faces(mesh: Mesh) -> int | None:
    """Count the faces that pass through another one, by pymeshlab; None where it is not installed.

    Neighbours that share a vertex do not count.

    Coordinates must be finite. Time grows with the number of faces: about 3 s for a million.
    """
    proper = mesh.faces[~_names_twice(mesh)]
    if not len(proper):
        return 0
    try:
        work = to_meshlab(Mesh(mesh.vertices, proper))
    except UsageError:
        return None
    work.compute_selection_by_self_intersections_per_face()
    return int(work.current_mesh().selected_face_number())


def _names_twice(mesh: Mesh) -> Mask:
    """Which faces name a vertex twice, of shape (F,)."""
    return np.asarray((mesh.faces == np.roll(mesh.faces, 1, axis=1)).any(axis=1))


def _flat_faces(mesh: Mesh, *, rounding: float = 4 * np.finfo(np.float64).eps) -> int:
    """Count faces whose height is at most `rounding`, a few units in the last place, times the largest coordinate."""
    corners = mesh.corners
    # Height times longest side is twice the area; `face_vectors` are as long as the area.
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    heights = 2 * np.linalg.norm(mesh.face_vectors, axis=1)
    largest = np.abs(mesh.vertices).max(initial=0.0)
    return int(((heights <= rounding * largest * sides) & ~_names_twice(mesh)).sum())


def _shown(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


_FACTS = {
    "sound": "non-empty, closed, oriented 2-manifold around a positive volume",
    "vertices": "that faces use",
    "faces": "",
    "components": "parts that share no vertex",
    "genus": "handles of all components together",
    "euler_characteristic": "vertices - edges + faces",
    "area": "in squared units of the file",
    "volume": "in cubed units of the file; positive when the faces look outward",
    "closed": "no edge has a single face",
    "manifold": "no edge has more than two faces, no vertex several fans of them, no face a vertex twice",
    "oriented": "the two faces of each edge walk it in opposite directions",
    "boundary_edges": "with one face",
    "crowded_edges": "with more than two faces",
    "turned_edges": "that both faces walk the same way",
    "split_vertices": "where several fans of faces touch",
    "degenerate_faces": "that name a vertex twice",
}

_COUNTS = {
    "repeated_faces": "with the three vertices of an earlier one",
    "flat_faces": "of three different vertices, without area",
    "self_intersecting_faces": "that pass through another face",
    "unused_vertices": "that no face names",
    "coincident_vertices": "at the place of an earlier one",
    "broken_vertices": "with coordinates that are not finite",
}
