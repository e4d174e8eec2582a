"""3MF, the 3D Manufacturing Format: an XML model in a ZIP archive, with colours by its materials extension.

Implemented here because the format's own library and trimesh store coordinates in float32 or drop colours. Written
files have one object, in millimetres, the unit that readers assume; coordinates are text with all digits of float64.
Most readers convert them to float32, so a mesh far from the origin is stored relative to its middle, and the build item
has the translation. Archive members have a fixed date, so that equal meshes give equal bytes.
Models may be large, so their XML is parsed as a stream, without a tree.

Specifications: 3MF Core 1.3, Materials and Properties 1.2 (https://3mf.io/spec).
"""

from __future__ import annotations

import posixpath
import zipfile
import zlib
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.parsers import expat

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.colors import as_bytes, with_alpha
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, concatenated, without_opaque_alpha
from gnrecon.io.io_parameters import IOParameters
from gnrecon.io.parse import format_rows, parse_numbers, require_buildable
from gnrecon.runtime.errors import InputError

_NAMESPACES = {
    "core": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02",
    "materials": "http://schemas.microsoft.com/3dmanufacturing/material/2015/02",
    "model": "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel",
}
"""XML namespaces of the model, and the type of the relationship that leads to it."""


def write_3mf(mesh: Mesh, path: Path) -> None:
    """Write one object with all digits of float64, and colours where the mesh has them; 3MF has no vertex normals."""
    declaration = '<?xml version="1.0" encoding="UTF-8"?>\n'
    types = (
        '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">\n'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>\n'
        '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>\n</Types>\n'
    )
    relations = (
        '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">\n'
        f'<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="{_NAMESPACES["model"]}"/>\n</Relationships>\n'
    )
    parts = {"[Content_Types].xml": [types], "_rels/.rels": [relations], "3D/3dmodel.model": _model(mesh)}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, blocks in parts.items():
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))  # the first date that a ZIP archive can store
            entry.compress_type = zipfile.ZIP_DEFLATED
            # The size is not known before, and may exceed the 4 GiB of the older format.
            with archive.open(entry, "w", force_zip64=True) as file:
                file.write(declaration.encode("ascii"))
                for block in blocks:
                    file.write(block.encode("ascii"))


def _model(mesh: Mesh) -> Iterator[str]:
    """The model's XML, in blocks: the resources are a group of colours, with the number 1, and the object, 2."""
    colors, shift, corners = mesh.attributes.get("colors"), _shift(mesh), mesh.faces
    core, materials = _NAMESPACES["core"], _NAMESPACES["materials"]
    yield f'<model unit="millimeter" xml:lang="en-US" xmlns="{core}" xmlns:m="{materials}">\n<resources>\n'
    default = paint = ""
    if colors is not None:
        # The distinct colours as RGBA numbers, and the index of each vertex' among them.
        codes = np.ascontiguousarray(with_alpha(as_bytes(colors))).view(">u4")[:, 0].astype(np.uint32)
        palette, which = np.unique(codes, return_inverse=True)
        default, paint = ' pid="1" pindex="0"', ' pid="1" p1="%d" p2="%d" p3="%d"'
        corners = np.hstack([mesh.faces, which[mesh.faces]])
        yield '<m:colorgroup id="1">\n'
        yield from format_rows('<m:color color="#%08X"/>\n', palette)
        yield "</m:colorgroup>\n"
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    closed = (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    kind = "model" if closed else "surface"  # as the specification says
    yield f'<object id="2" type="{kind}"{default}>\n<mesh>\n<vertices>\n'
    yield from format_rows('<vertex x="%r" y="%r" z="%r"/>\n', mesh.vertices - shift)
    yield "</vertices>\n<triangles>\n"
    yield from format_rows(f'<triangle v1="%d" v2="%d" v3="%d"{paint}/>\n', corners)
    matrix = "1 0 0 0 1 0 0 0 1 {!r} {!r} {!r}".format(*shift.tolist())
    item = f' transform="{matrix}"' if shift.any() else ""
    yield "</triangles>\n</mesh>\n</object>\n</resources>\n"
    yield f'<build>\n<item objectid="2"{item}/>\n</build>\n</model>\n'


def _shift(mesh: Mesh) -> Float:
    """What is subtracted from the coordinates, of shape (3,): zero, unless float32 rounding would be visible."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    rounding = float(np.abs(mesh.vertices).max()) * float(np.finfo(np.float32).eps)
    visible = IOParameters.visible_rounding_diagonals * float(np.linalg.norm(high - low))
    return (low + high) / 2 if rounding > visible else np.zeros(3)


Key = tuple[str, str]
"""A resource: the part of the archive that holds it, and its number in that part."""


@dataclass
class _Object:
    """One object: its own mesh, its corners' colours as RGBA numbers (-1 for none), and its component objects."""

    group: str = ""
    place: str = ""
    vertices: array[float] = field(default_factory=lambda: array("d"))
    corners: array[int] = field(default_factory=lambda: array("q"))
    colors: array[int] = field(default_factory=lambda: array("q"))
    parts: list[tuple[Key, Float]] = field(default_factory=list)


class _Model:
    """Everything that the parts of an archive define; only its main part may build objects."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self.objects: dict[Key, _Object] = {}
        self.items: list[tuple[Key, Float]] = []
        self._colors: dict[Key, list[int]] = {}
        self._group: list[int] = []
        self._object = _Object()
        self._relations: list[str] = []
        self._parse(archive, "_rels/.rels", self._relation)
        if not self._relations:
            raise InputError("the archive names no 3MF model.")
        self._main = self._part = self._relations[0]
        waiting, seen = [self._main], {self._main}
        while waiting:
            self._part = waiting.pop()
            self._parse(archive, self._part, self._element)
            inner = [key for one in self.objects.values() for key, _ in one.parts] + [key for key, _ in self.items]
            waiting += sorted({part for part, _ in inner} - seen)
            seen |= {part for part, _ in inner}

    def _parse(self, archive: zipfile.ZipFile, part: str, start: Callable[[str, dict[str, str]], None]) -> None:
        parser = expat.ParserCreate(namespace_separator="}")
        parser.StartElementHandler = start
        with archive.open(part) as file:
            parser.ParseFile(file)

    def _relation(self, tag: str, values: dict[str, str]) -> None:
        if tag.endswith("}Relationship") and values.get("Type") == _NAMESPACES["model"]:
            self._relations.append(values.get("Target", "").lstrip("/"))

    def _element(self, tag: str, values: dict[str, str]) -> None:
        match tag.rpartition("}")[2]:
            case "vertex":
                self._object.vertices.extend((float(values["x"]), float(values["y"]), float(values["z"])))
            case "triangle":
                self._triangle(values)
            case "object":
                self._object = _Object(values.get("pid", ""), values.get("pindex", ""))
                self.objects[self._part, values["id"]] = self._object
            case "colorgroup" | "basematerials":
                self._group = self._colors.setdefault((self._part, values["id"]), [])
            case "color" | "base":
                # RRGGBB or RRGGBBAA; without an alpha channel, colours are opaque.
                text = values.get("color", values.get("displaycolor", ""))
                self._group.append(int(text.lstrip("#").ljust(8, "F")[:8], 16))
            case "component":
                self._object.parts.append(self._reference(values))
            case "item" if self._part == self._main:
                self.items.append(self._reference(values))

    def _triangle(self, values: dict[str, str]) -> None:
        current = self._object
        current.corners.extend((int(values["v1"]), int(values["v2"]), int(values["v3"])))
        known = self._colors.get((self._part, values.get("pid", current.group)))
        first = values.get("p1", current.place)
        places = (first, values.get("p2", first), values.get("p3", first))
        current.colors.extend(-1 if known is None or not first else known[int(place)] for place in places)

    def _reference(self, values: dict[str, str]) -> tuple[Key, Float]:
        """The object that a component or an item refers to, and the 4 x 3 matrix that moves rows (x, y, z, 1)."""
        matrix = parse_numbers(values["transform"].split()).reshape(4, 3) if "transform" in values else np.eye(4, 3)
        # With the production extension, the object may be in another part.
        path = next((value for name, value in values.items() if name.endswith("}path")), self._part)
        return (posixpath.normpath(path).lstrip("/"), values["objectid"]), matrix


def read_3mf(path: Path) -> Contents:
    """Read all objects that the model builds into one mesh, each moved by its transform; lengths as stored."""
    try:
        with zipfile.ZipFile(path) as archive:
            model = _Model(archive)
    except (zipfile.BadZipFile, zlib.error, expat.ExpatError, KeyError, EOFError) as error:
        raise InputError(f"the file is not a well-formed 3MF archive ({error}).") from None
    _require_bounded(model)
    found = concatenated([piece for key, matrix in model.items for piece in _transformed(model, key, matrix)])
    if not len(found.points):
        raise InputError("the 3MF model builds no mesh.")
    return replace(found, attributes=without_opaque_alpha(found.attributes) if found.attributes["colors"].any() else {})


def _require_bounded(model: _Model, *, most_depth: int = 32, most_instances: int = 100_000) -> None:
    """Refuse a model that builds more than memory holds; objects that contain others twice multiply at each level."""
    known: dict[Key, tuple[int, int, int]] = {}

    def counted(key: Key, depth: int) -> tuple[int, int, int]:
        """Instances, numbers and levels of an object with all that it contains."""
        if key not in known:
            if key not in model.objects or depth > most_depth:
                why = "which does not exist or contains itself"
                raise InputError(f"the 3MF model builds the object {key[1]!r}, {why}.")
            inner = [counted(part, depth + 1) for part, _ in model.objects[key].parts]
            instances, numbers, levels = zip(*inner, strict=True) if inner else ((), (), (0,))
            known[key] = (1 + sum(instances), _numbers(model.objects[key]) + sum(numbers), 1 + max(levels))
        if known[key][2] > most_depth:
            raise InputError(f"the 3MF model nests objects more than {most_depth} levels deep.")
        return known[key]

    totals = [counted(key, 0) for key, _ in model.items]
    instances, numbers = (sum(total[column] for total in totals) for column in (0, 1))
    require_buildable(instances, numbers, sum(map(_numbers, model.objects.values())), most_instances)


def _numbers(current: _Object) -> int:
    return len(current.vertices) + len(current.corners)


def _transformed(model: _Model, key: Key, matrix: Float) -> Iterator[Contents]:
    """The meshes of an object and its components, moved into place; the model has no cycles, see `_require_bounded`."""
    current = model.objects[key]
    if current.corners:
        yield _mesh(current, matrix)
    for inner, step in current.parts:
        # Transforms move rows (x, y, z, 1), so the inner one comes first, as a 4 x 4 matrix.
        yield from _transformed(model, inner, np.hstack([step, np.eye(4)[:, 3:]]) @ matrix)


def _mesh(current: _Object, matrix: Float) -> Contents:
    """The object's own mesh in place, with RGBA colours, zero where there are none."""
    vertices = np.array(current.vertices, dtype=np.float64).reshape(-1, 3)
    corners, codes = np.array(current.corners, dtype=np.int64), np.array(current.colors, dtype=np.int64)
    colors = np.zeros((len(vertices), 4), dtype=np.uint8)
    if not (matrix[:3] == np.eye(3)).all():
        vertices = vertices @ matrix[:3]
    # A mirroring matrix would turn faces inside out, so their corners are reversed.
    turned = corners.reshape(-1, 3)[:, :: 1 if np.linalg.det(matrix[:3]) > 0 else -1]
    mesh = Mesh(vertices + matrix[3], turned)  # which refuses indices of other objects' vertices
    # Where the corners at a vertex differ, the first one's colour is written last.
    painted = np.flatnonzero(codes != -1)[::-1]
    colors[corners[painted]] = codes[painted].astype(">u4").view(np.uint8).reshape(-1, 4)
    return Contents(mesh.vertices, None, mesh.faces, {"colors": colors})
