"""The columns of a PLY file's vertices: positions, normals, colours by their customary names, and other attributes."""

from __future__ import annotations

import re

import numpy as np

from gnrecon.geometry.arrays import Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh

Column = tuple[str, str, Values]
"""Name, PLY's name of the type, and values of shape (V,)."""

_COLORS = ("red", "green", "blue", "alpha")
_RESERVED = ("x", "y", "z", "nx", "ny", "nz", *_COLORS)
_KINDS = {
    **{"b1": "uchar", "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"},
    **{"f2": "float", "f4": "float", "f8": "double"},
}
_NARROWER = ("int", np.iinfo(np.int32)), ("uint", np.iinfo(np.uint32))


def vertex_columns(mesh: Mesh) -> list[Column]:
    """Return all columns of a mesh; an attribute of several columns becomes NAME_0, NAME_1, and so on."""
    columns: list[Column] = [(name, "double", mesh.vertices[:, axis]) for axis, name in enumerate("xyz")]
    if mesh.normals is not None:
        columns += [(f"n{name}", "float", mesh.normals[:, axis]) for axis, name in enumerate("xyz")]
    if "colors" in mesh.attributes:
        bytes_ = as_bytes(mesh.attributes["colors"])
        columns += [(name, "uchar", values) for name, values in zip(_COLORS, bytes_.T, strict=False)]
    taken = set(_RESERVED)
    for name, values in mesh.attributes.items():
        if name != "colors":
            rows = values.reshape(len(values), -1).T
            names = [name] if values.ndim == 1 else [f"{name}_{number}" for number in range(len(rows))]
            columns += [(_free(one, taken), _kind(row), row) for one, row in zip(names, rows, strict=True)]
    return columns


def _free(name: str, taken: set[str]) -> str:
    """Return the name as one ASCII word that no other column has, and add it to those taken."""
    word = re.sub(r"[^!-~]", "_", name) or "_"
    while word.lower() in taken:
        word += "_"
    taken.add(word.lower())
    return word


def _kind(values: Values) -> str:
    """PLY's type for a column; 64-bit integers become 32-bit ones where they fit, else doubles."""
    kind = _KINDS.get(values.dtype.str[1:])
    if kind is not None:
        return kind
    if values.dtype.kind in "iu" and len(values):
        for name, limits in _NARROWER:
            if limits.min <= values.min() and values.max() <= limits.max:
                return name
    return "double"
