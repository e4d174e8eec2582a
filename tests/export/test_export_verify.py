"""Each defect that a mesh can have is planted and must be named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_fields import UTM, Field, shells, sphere, torus
from planted_defects import touching_in_a_vertex, touching_in_an_edge, with_a_fin, with_a_flipped_face

from gnrecon.export import extract, require_sound, verify, verify_file
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh
from gnrecon.runtime.errors import MeshError


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return extract(Field(sphere()), resolution=16)


def test_facts_of_known_shapes() -> None:
    facts = verify(extract(Field(torus(), frame=UTM), resolution=64))
    assert (facts.components, facts.euler_characteristic, facts.genus) == (1, 0, 1)
    assert facts.closed
    assert facts.manifold
    assert facts.oriented
    assert facts.area == pytest.approx(4 * np.pi**2 * 0.6 * 0.2 * UTM.scale**2, rel=0.01)
    nested = verify(extract(Field(shells()), resolution=64))
    assert (nested.components, nested.euler_characteristic, nested.genus) == (3, 6, 0)
    assert nested.as_dict()["components"] == 3


def test_each_planted_defect_is_named(ball: Mesh) -> None:
    nothing = Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    shifted = ball.vertices.copy()
    shifted[3, 1] = np.nan
    collapsed = np.vstack([ball.faces, [[0, 0, 1]]])
    defects = {
        "is empty": nothing,
        "open: 3 edges have only one face": Mesh(ball.vertices, ball.faces[1:]),
        "open: 2 edges": with_a_fin(ball),
        "1 edges shared by more than two faces": touching_in_an_edge(),
        "faces disagree across 3 edges": with_a_flipped_face(ball),
        "1 vertices where several fans": touching_in_a_vertex(ball),
        "inside out: its volume is -": Mesh(ball.vertices, ball.faces[:, ::-1]),
        "1 vertices that are not finite": Mesh(shifted, ball.faces),
        "1 faces that name a vertex twice": Mesh(ball.vertices, collapsed),
    }
    for sentence, mesh in defects.items():
        with pytest.raises(MeshError, match=sentence):
            require_sound(mesh)
    assert verify(with_a_fin(ball)).crowded_edges == 1


@pytest.mark.parametrize("seed", range(3))
def test_counts_agree_with_a_slow_walk_over_the_faces(ball: Mesh, seed: int) -> None:
    """Random faces are dropped, flipped and doubled; half-edges are then counted in a dictionary."""
    rng = np.random.default_rng(seed)
    faces = ball.faces[rng.random(len(ball.faces)) > 0.02]
    flips = rng.random(len(faces)) < 0.02
    faces = np.where(flips[:, None], faces[:, ::-1], faces)
    faces = np.concatenate([faces, faces[rng.random(len(faces)) < 0.02]])
    walked: dict[frozenset[int], list[bool]] = {}
    for face in faces.tolist():
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            walked.setdefault(frozenset((a, b)), []).append(a < b)
    facts = verify(Mesh(ball.vertices, faces))
    assert facts.boundary_edges == sum(len(ways) == 1 for ways in walked.values()) > 0
    assert facts.crowded_edges == sum(len(ways) > 2 for ways in walked.values()) > 0
    assert facts.turned_edges == sum(len(w) == 2 and w[0] == w[1] for w in walked.values()) > 0
    assert not facts.closed
    assert facts.genus is None


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".stl"])
def test_files_are_verified_as_they_lie_on_disk(ball: Mesh, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ball{suffix}"
    write_mesh(ball, path)
    assert verify_file(path).faces == len(ball.faces)
    broken = tmp_path / f"broken{suffix}"
    write_mesh(Mesh(ball.vertices, ball.faces[1:]), broken)
    with pytest.raises(MeshError, match=r"broken.*is open"):
        verify_file(broken)
