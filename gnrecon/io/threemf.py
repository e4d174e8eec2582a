"""3MF, the 3D Manufacturing Format: an XML model in a ZIP archive, with colours by its materials extension.

Written here because the format's own library and trimesh hold coordinates in float32 or drop colours. A file that is
written has one object, in millimetres, the unit that readers assume; coordinates are text with all digits of float64.
Most readers turn them into float32, so a mesh far from the origin is stored about its middle, and the item that builds
it carries the way there. Archive members have a fixed date, so that equal meshes give equal bytes.

Specifications: 3MF Core 1.3, Materials and Properties 1.2 (https://3mf.io/spec).
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.colors import as_bytes, with_alpha
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.parse import format_rows

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
MATERIAL = "http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
MODEL_TYPE = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"

_FAR = 1e-6
"""Rounding to float32, as a share of the mesh's diagonal, from which on it is stored about its middle."""

_EPOCH = (1980, 1, 1, 0, 0, 0)
_DECLARATION = '<?xml version="1.0" encoding="UTF-8"?>\n'
_TYPES = (
    f'{_DECLARATION}<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">\n'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>\n'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>\n</Types>\n'
)
_RELATIONS = (
    f'{_DECLARATION}<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">\n'
    f'<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="{MODEL_TYPE}"/>\n</Relationships>\n'
)
_COLORS, _OBJECT = 1, 2
"""Numbers of the two resources."""


def write_3mf(mesh: Mesh, path: Path) -> None:
    """Write one object with all digits of float64, and colours where the mesh has them; 3MF has no vertex normals."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, blocks in (
            ("[Content_Types].xml", iter([_TYPES])),
            ("_rels/.rels", iter([_RELATIONS])),
            ("3D/3dmodel.model", _model(mesh)),
        ):
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as file:
                for block in blocks:
                    file.write(block.encode("ascii"))


def _model(mesh: Mesh) -> Iterator[str]:
    """The model's XML, in blocks."""
    colors = mesh.attributes.get("colors")
    shift = _shift(mesh)
    yield f'{_DECLARATION}<model unit="millimeter" xml:lang="en-US" xmlns="{CORE}" xmlns:m="{MATERIAL}">\n<resources>\n'
    which = None
    if colors is not None:
        palette, which = _palette(with_alpha(as_bytes(colors)))
        yield f'<m:colorgroup id="{_COLORS}">\n'
        yield from format_rows('<m:color color="#%08X"/>\n', palette)
        yield "</m:colorgroup>\n"
    kind = "model" if _is_closed(mesh) else "surface"
    default = "" if colors is None else f' pid="{_COLORS}" pindex="0"'
    yield f'<object id="{_OBJECT}" type="{kind}"{default}>\n<mesh>\n<vertices>\n'
    yield from format_rows('<vertex x="%r" y="%r" z="%r"/>\n', mesh.vertices - shift)
    yield "</vertices>\n<triangles>\n"
    if which is None:
        yield from format_rows('<triangle v1="%d" v2="%d" v3="%d"/>\n', mesh.faces)
    else:
        corners = np.hstack([mesh.faces, which[mesh.faces]])
        template = f'<triangle v1="%d" v2="%d" v3="%d" pid="{_COLORS}" p1="%d" p2="%d" p3="%d"/>\n'
        yield from format_rows(template, corners)
    way = "1 0 0 0 1 0 0 0 1 {!r} {!r} {!r}".format(*shift.tolist())
    item = f' transform="{way}"' if shift.any() else ""
    yield "</triangles>\n</mesh>\n</object>\n</resources>\n"
    yield f'<build>\n<item objectid="{_OBJECT}"{item}/>\n</build>\n</model>\n'


def _palette(colors: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[np.uint32], Int]:
    """Different colours as RGBA numbers, and for each row of `colors`, of shape (V, 4), which of them it is."""
    return np.unique(np.ascontiguousarray(colors).view(">u4")[:, 0].astype(np.uint32), return_inverse=True)


def _shift(mesh: Mesh) -> Float:
    """What is taken from the coordinates, of shape (3,): nothing, unless float32 would spoil them."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    rounding = float(np.abs(mesh.vertices).max()) * float(np.finfo(np.float32).eps)
    return (low + high) / 2 if rounding > _FAR * float(np.linalg.norm(high - low)) else np.zeros(3)


def _is_closed(mesh: Mesh) -> bool:
    """Whether every edge has two faces; only such an object may call itself a model."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    return bool((counts == 2).all())
