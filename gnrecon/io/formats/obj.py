"""OBJ, Wavefront's text format: positions, vertex normals and polygons.

Vertices are kept as they are, in their order. Readers for rendering split a vertex wherever its texture or normal
differs between faces, which opens closed surfaces; here a vertex gets the mean of its corners' normals.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, fan_triangles, no_faces, polygon_remarks
from gnrecon.io.parse import format_rows, parse_rows, read_text
from gnrecon.runtime.errors import InputError


def read_obj(path: Path) -> Contents:
    """Read vertices (with colours, where they follow the position), vertex normals and faces."""
    # A backslash at the end of a line continues it.
    text = re.sub(r"\\\r?\n", " ", read_text(path))
    # The keyword of each line, and the words that follow it.
    lines = [[*line.partition("#")[0].split(None, 1), "", ""][:2] for line in text.splitlines()]
    points, colors, lost = _vertices([rest for word, rest in lines if word == "v"])
    normals = parse_rows([rest for word, rest in lines if word == "vn"], "the 'vn' lines")
    if not len(points):
        raise InputError("the file holds no vertex line ('v x y z').")
    faces = [rest.split() for word, rest in lines if word == "f"]
    # Corners are v, v/t, v//n or v/t/n.
    counts, corners = np.array(list(map(len, faces)), np.int64), [corner for face in faces for corner in face]
    if not len(counts):
        # Without faces nothing links normals to vertices; as many normals as vertices belong to them in order.
        given = normals[:, :3] if len(normals) == len(points) else None
        return Contents(points, given, no_faces(), colors, _unread(lines) + lost)
    corner_vertices = _indices([word.partition("/")[0] for word in corners], lines, counts, "v")
    if corner_vertices.max() >= len(points):
        raise InputError(f"a face names vertex {corner_vertices.max() + 1}, but there are {len(points)}.")
    given = _normals(corners, corner_vertices, normals, lines, counts, len(points))
    unread = _unread(lines) + lost + polygon_remarks(counts)
    return Contents(points, given, fan_triangles(counts, corner_vertices), colors, unread)


def _vertices(lines: list[str]) -> tuple[Float, dict[str, Float], tuple[str, ...]]:
    """Return positions, colours where every vertex has one (after x y z or x y z w), and what is not read."""
    widths = {len(line.split()) for line in lines}
    if len(widths) > 1 and min(widths) >= 3:
        # Only some vertices have a weight or a colour; a made-up one for the others would look like a measured one.
        lost = () if max(widths) < 6 else ("colours, which only some of the vertices have",)
        return parse_rows([" ".join(line.split()[:3]) for line in lines], "the 'v' lines"), {}, lost
    vertices = parse_rows(lines, "the 'v' lines")
    colors = {"colors": vertices[:, 3:6]} if vertices.shape[1] in (6, 7) else {}
    return np.ascontiguousarray(vertices[:, :3]), colors, ()


def _unread(lines: list[list[str]]) -> tuple[str, ...]:
    """Describe the lines that are not read."""
    names = {"vt": "texture coordinates", "usemtl": "materials", "l": "lines", "p": "points"}
    names |= dict.fromkeys(("curv", "surf"), "free-form curves and surfaces")
    names |= dict.fromkeys(("o", "g"), "names of objects and groups")
    kinds = {word for word, _ in lines}
    return tuple(dict.fromkeys(name for word, name in names.items() if word in kinds))


def _indices(words: list[str], lines: list[list[str]], counts: Int, kind: str) -> Int:
    """Return zero-based indices; a negative one counts back from the lines of its `kind` that precede its face."""
    try:
        stated = np.array(list(map(int, words)), np.int64)
    except ValueError:
        raise InputError("a face holds a corner that is not a vertex index.") from None
    before = np.zeros(len(words), np.int64)
    if (stated < 0).any():
        seen = np.cumsum([word == kind for word, _ in lines])
        before = np.repeat(seen[[word == "f" for word, _ in lines]], counts)
    indices: Int = np.where(stated < 0, before + stated, stated - 1)
    if (indices < 0).any():
        raise InputError(f"a face names {kind} {stated[indices < 0][0]}, but indices begin at 1.")
    return indices


def _normals(
    corners: list[str], corner_vertices: Int, normals: Float, lines: list[list[str]], counts: Int, size: int
) -> Float | None:
    """Return a normal for every vertex, or None where not all corners name one."""
    words = [word.split("/")[2] if word.count("/") == 2 else "" for word in corners]
    if not len(normals) or not all(words):
        return None
    corner_normals = _indices(words, lines, counts, "vn")
    if corner_normals.max() >= len(normals):
        raise InputError(f"a face names normal {corner_normals.max() + 1}, but there are {len(normals)}.")
    if len(normals) == size and (corner_normals == corner_vertices).all():
        return normals[:, :3]  # exactly as stored
    sums = np.zeros((size, 3))
    np.add.at(sums, corner_vertices, normals[corner_normals, :3])
    lengths: Float = np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return sums / lengths


def write_obj(mesh: Mesh, path: Path) -> None:
    """Write positions with all digits of float64, vertex normals where the mesh has them, and triangles.

    Colours follow the positions as shares of full brightness, which is not part of the format but widely supported.
    """
    colors = mesh.attributes.get("colors")
    shades = np.empty((len(mesh.vertices), 0)) if colors is None else as_bytes(colors)[:, :3] / 255
    blocks = format_rows(f"v %r %r %r{' %.4f' * shades.shape[1]}\n", np.hstack([mesh.vertices, shades]))
    corners = mesh.faces + 1
    if mesh.normals is None:
        blocks += format_rows("f %d %d %d\n", corners)
    else:
        blocks += format_rows("vn %.7g %.7g %.7g\n", mesh.normals)
        blocks += format_rows("f %d//%d %d//%d %d//%d\n", np.repeat(corners, 2, axis=1))
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(blocks)
