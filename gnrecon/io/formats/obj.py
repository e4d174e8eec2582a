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
    text = "\n".join(re.sub(r"\\\r?\n", " ", read_text(path)).splitlines())
    # The keyword of each line, and the words that follow it; as tuples, which Python does not search for garbage.
    lines: list[tuple[str, str]] = re.findall(r"^[^\S\n]*([^\s#]*)[^\S\n]*([^\n#]*)", text, re.MULTILINE)
    points, colors, lost = _vertices([rest for word, rest in lines if word == "v"])
    normals = parse_rows([rest for word, rest in lines if word == "vn"], "the 'vn' lines")
    if not len(points):
        raise InputError("the file holds no vertex line ('v x y z').")
    polygons = [rest for word, rest in lines if word == "f"]
    if (triangles := _plain_triangles(polygons, len(points), len(normals))) is not None:
        corners_of, normals_of = triangles
        given = (
            None if normals_of is None else _normals_at(corners_of.ravel(), normals_of.ravel(), normals, len(points))
        )
        return Contents(points, given, corners_of, colors, _unread(lines) + lost)
    faces = [rest.split() for rest in polygons]
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


def _plain_triangles(lines: list[str], vertices: int, normals: int) -> tuple[Int, Int | None] | None:
    """Return the triangles' vertices and, where corners name any, normals, zero-based, of shape (F, 3).

    Most files hold triangles alone, whose corners are all v or all v//n; numpy reads them ten times as fast as word by
    word. It is None of any other faces, and of indices that are none of a vertex or normal.
    """
    text = "\n".join(lines)
    corner = r"[0-9]{1,15}//[0-9]{1,15}" if normals and "//" in text else r"[0-9]{1,15}"
    if not lines or re.fullmatch(rf"(?:{corner}[ \t]+{corner}[ \t]+{corner}[ \t]*(?:\n|\Z))+", text) is None:
        return None
    numbers = np.fromstring(text.replace("//", " "), np.int64, sep=" ").reshape(len(lines), 3, -1) - 1
    kinds = numbers.shape[2]
    if numbers.min() < 0 or (numbers.max(axis=(0, 1)) >= (vertices, normals)[:kinds]).any():
        return None
    return np.ascontiguousarray(numbers[..., 0]), numbers[..., 1] if kinds == 2 else None


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


def _unread(lines: list[tuple[str, str]]) -> tuple[str, ...]:
    """Describe the lines that are not read."""
    names = {"vt": "texture coordinates", "usemtl": "materials", "l": "lines", "p": "points"}
    names |= dict.fromkeys(("curv", "surf"), "free-form curves and surfaces")
    names |= dict.fromkeys(("o", "g"), "names of objects and groups")
    kinds = {word for word, _ in lines}
    return tuple(dict.fromkeys(name for word, name in names.items() if word in kinds))


def _indices(words: list[str], lines: list[tuple[str, str]], counts: Int, kind: str) -> Int:
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
    corners: list[str], corner_vertices: Int, normals: Float, lines: list[tuple[str, str]], counts: Int, size: int
) -> Float | None:
    """Return a normal for every vertex, or None where not all corners name one."""
    words = [word.split("/")[2] if word.count("/") == 2 else "" for word in corners]
    if not len(normals) or not all(words):
        return None
    corner_normals = _indices(words, lines, counts, "vn")
    if corner_normals.max() >= len(normals):
        raise InputError(f"a face names normal {corner_normals.max() + 1}, but there are {len(normals)}.")
    return _normals_at(corner_vertices, corner_normals, normals, size)


def _normals_at(corner_vertices: Int, corner_normals: Int, normals: Float, size: int) -> Float:
    """Return the normal of each vertex: the direction of the sum over its corners."""
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
