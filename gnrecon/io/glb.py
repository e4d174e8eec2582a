"""GLB, binary glTF, by trimesh.

glTF stores float32. Positions are therefore stored relative to the middle of the mesh's bounding box, and the node's
matrix, whose numbers are JSON text with all digits, carries the offset.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.errors import InputError
from gnrecon.io.contents import Contents, no_faces
from gnrecon.mesh import Mesh


def read_glb(path: Path) -> Contents:
    """Read all meshes of the scene into one, each moved by its node's matrix.

    Raises
    ------
    InputError
        When the file is malformed or holds no vertices.
    """
    import trimesh

    try:
        with path.open("rb") as file:
            scene = trimesh.load_scene(file, file_type="glb", process=False, skip_materials=True)
    # A malformed file surfaces as whatever the parser of JSON and buffers happens to raise.
    except Exception as error:
        raise InputError(f"the file is not a well-formed GLB ({type(error).__name__}: {error}).") from None
    vertices, normals, faces, start = [], [], [], 0
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        part = scene.geometry[name]
        vertices.append(np.asarray(part.vertices) @ matrix[:3, :3].T + matrix[:3, 3])
        triangles = np.asarray(part.faces, np.int64) if hasattr(part, "faces") else no_faces()
        # A mirroring matrix turns faces inside out, so their corners are reversed.
        faces.append((triangles if np.linalg.det(matrix[:3, :3]) > 0 else triangles[:, ::-1]) + start)
        turned = np.asarray(getattr(part, "vertex_normals", np.zeros((len(part.vertices), 3))))
        normals.append(turned @ np.linalg.inv(matrix[:3, :3]))
        start += len(part.vertices)
    if not start:
        raise InputError("the file holds no vertices.")
    directions = np.concatenate(normals)
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.divide(directions, lengths, out=np.zeros_like(directions), where=lengths > 0)
    all_faces = np.concatenate(faces)
    return Contents(np.concatenate(vertices), directions if len(all_faces) else None, all_faces)


def write_glb(mesh: Mesh, path: Path) -> None:
    """Write one node with the mesh, its vertex normals, and a translation to the mesh's middle."""
    import trimesh

    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    matrix = np.eye(4)
    matrix[:3, 3] = middle
    part = trimesh.Trimesh(
        mesh.vertices - middle, mesh.faces, vertex_normals=mesh.vertex_normals(), process=False, validate=False
    )
    scene: Any = trimesh.Scene()
    scene.add_geometry(part, node_name="mesh", transform=matrix)
    path.write_bytes(scene.export(file_type="glb", include_normals=True))
