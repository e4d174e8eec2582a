"""OFF, the Object File Format: counts, vertices and polygons in text, with the variants COFF, NOFF and CNOFF.

It is parsed here because trimesh drops the normals and colours of vertices.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Int
from gnrecon.geometry.colors import as_bytes, with_alpha
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, fan_triangles, no_faces, polygon_remarks
from gnrecon.io.parse import format_rows, parse_numbers, parse_rows, read_text
from gnrecon.runtime.errors import InputError


def read_off(path: Path) -> Contents:
    """Read vertices, the normals and colours that NOFF and COFF add, and faces."""
    lines = [line for row in read_text(path).splitlines() if (line := row.partition("#")[0].strip())]
    keyword = re.match(r"(ST)?(C)?(N)?OFF\b", lines[0], re.IGNORECASE) if lines else None
    if keyword is None or "BINARY" in lines[0].upper():
        raise InputError("expected a text file that begins with the word OFF.")
    rest = lines[0][keyword.end() :].split()
    # Some files have the counts on the line of the keyword.
    words, lines = (rest, lines[1:]) if rest else (" ".join(lines[1:2]).split(), lines[2:])
    if len(words) < 2 or not all(word.isdecimal() for word in words[:2]):
        raise InputError(f"expected the numbers of vertices and faces, but found {' '.join(words)[:60]!r}.")
    vertex_count, face_count = int(words[0]), int(words[1])
    if len(lines) < vertex_count + face_count:
        stated = f"{vertex_count} vertices and {face_count} faces"
        raise InputError(f"the header declares {stated}, but {len(lines)} rows follow.")
    if not vertex_count:
        raise InputError("the header declares no vertices.")
    table = parse_rows(lines[:vertex_count], "the vertex rows")
    has_normals, has_colors = bool(keyword[3]), bool(keyword[2])
    if has_normals and table.shape[1] < 6:
        raise InputError(f"NOFF vertices need 6 numbers each, but hold {table.shape[1]}.")
    first_color = 6 if has_normals else 3
    colors = {"colors": table[:, first_color : first_color + 4]} if has_colors and table.shape[1] > first_color else {}
    faces, unread = _faces(lines[vertex_count : vertex_count + face_count])
    points = np.ascontiguousarray(table[:, :3])
    return Contents(points, table[:, 3:6] if has_normals else None, faces, colors, unread)


def _faces(lines: list[str]) -> tuple[Int, tuple[str, ...]]:
    """Return the triangles of rows ``n i1 ... in [colour]``, and descriptions of what is not kept."""
    if not lines:
        return no_faces(), ()
    counts, corners, colored = [], [], False
    for line in lines:
        words = line.split()
        count = int(words[0]) if words[0].isdecimal() else -1
        if not 0 <= count < len(words):
            raise InputError(f"the face row {line[:60]!r} is not a count and as many vertex indices.")
        counts.append(count)
        corners += words[1 : count + 1]
        colored |= len(words) > count + 1
    sides = np.array(counts, np.int64)
    unread = ("colours of faces",) * colored + polygon_remarks(sides)
    return fan_triangles(sides, parse_numbers(corners).astype(np.int64)), unread


def write_off(mesh: Mesh, path: Path) -> None:
    """Write positions with all digits of float64 and triangles; as COFF where there are colours, without normals."""
    colors = mesh.attributes.get("colors")
    blocks = [f"{'OFF' if colors is None else 'COFF'}\n{len(mesh.vertices)} {len(mesh.faces)} 0\n"]
    shades = np.empty((len(mesh.vertices), 0)) if colors is None else with_alpha(as_bytes(colors))
    blocks += format_rows(f"%r %r %r{' %d' * shades.shape[1]}\n", np.hstack([mesh.vertices, shades]))
    blocks += format_rows("3 %d %d %d\n", mesh.faces)
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(blocks)
