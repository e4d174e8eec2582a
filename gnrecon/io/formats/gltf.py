"""GLB, binary glTF, by trimesh; glTF in text is turned into the same by `gltf.py`.

glTF stores float32. Positions are therefore stored relative to the middle of the mesh's bounding box, and the node's
matrix, whose numbers are JSON text with all digits, carries the offset.

Colours of vertices are linear light in glTF, which 8 bits would make too coarse in the dark: they are written, and
read, as the 16-bit numbers that the format also allows. trimesh knows 8 bits only, so it handles them as an attribute
of another name, and the file's JSON is renamed behind it. All other attributes are float32, named with an underscore.

Of bare points trimesh gives the positions alone. They are shown to it as triangles therefore, of which one names the
first point three times, by an accessor without a buffer, whose values are zero by the specification.
"""

from __future__ import annotations

import binascii
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from gnrecon.geometry.arrays import Values
from gnrecon.geometry.colors import as_bytes, to_linear, to_srgb, with_alpha
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, parsing
from gnrecon.io.parse import beside
from gnrecon.runtime.errors import InputError

_COLOR, _HIDDEN = "COLOR_0", "_COLOR_0"
"""The name of colours in glTF, and the one under which trimesh takes them for any attribute."""

_JSON = b"JSON"

_POINTS, _TRIANGLES, _UNSIGNED_BYTE = 0, 4, 5121

_NO_TRIANGLE = [[0, 0, 0]]
"""The faces of what are points only."""

_UNREAD = {
    b"TEXCOORD_0": "texture coordinates",
    b"textures": "textures",
    b"animations": "animations",
    b"skins": "skins",
}
"""Words of the JSON that name what is left out."""


def fits_glb(name: str, values: Values) -> bool:
    """Whether glTF can hold an attribute: finite numbers of up to four columns that float32 tells apart."""
    if name == "colors":
        return True
    if values.dtype.kind not in "biuf" or values.ndim > 2 or (values.ndim == 2 and values.shape[1] > 4):
        return False
    numbers = values.astype(np.float64)
    exact = values.dtype.kind == "f" or bool((numbers.astype(np.float32) == numbers).all())
    return exact and bool(np.isfinite(numbers.astype(np.float32)).all())


def read_glb(path: Path) -> Contents:
    """Read all meshes and clouds of the scene into one, each moved by its node's matrix.

    Attributes are kept where all meshes have them, with their names in lower case.

    Raises
    ------
    InputError
        When the file is malformed or holds no vertices.
    """
    return read_glb_bytes(path.read_bytes())


def read_glb_bytes(data: bytes) -> Contents:
    """Read the bytes of a GLB file, as `read_glb` does."""
    import trimesh

    with parsing("GLB"):
        file = trimesh.util.wrap_as_stream(_renamed(data))
        scene = trimesh.load_scene(file, file_type="glb", process=False, skip_materials=True)
        return _collected(scene, _unread(data))


def _collected(scene: Any, unread: tuple[str, ...]) -> Contents:
    """All that a scene shows, in one."""
    vertices, normals, faces, attributes, start = [], [], [], [], 0
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        part = scene.geometry[name]
        vertices.append(np.asarray(part.vertices) @ matrix[:3, :3].T + matrix[:3, 3])
        triangles = np.asarray(part.faces, np.int64)
        triangles = triangles[:0] if np.array_equal(triangles, _NO_TRIANGLE) else triangles
        # A mirroring matrix turns faces inside out, so their corners are reversed.
        faces.append((triangles if np.linalg.det(matrix[:3, :3]) > 0 else triangles[:, ::-1]) + start)
        normals.append(np.asarray(part.vertex_normals) @ np.linalg.inv(matrix[:3, :3]))
        attributes.append(part.vertex_attributes)
        start += len(part.vertices)
    if not start:
        raise InputError("the file holds no vertices.")
    directions = np.concatenate(normals)
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.divide(directions, lengths, out=np.zeros_like(directions), where=lengths > 0)
    given = directions if directions.any() else None
    return Contents(np.concatenate(vertices), given, np.concatenate(faces), _attributes(attributes), unread)


def _unread(data: bytes) -> tuple[str, ...]:
    """Name what else the file's JSON speaks of."""
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    return tuple(name for word, name in _UNREAD.items() if b'"' + word + b'"' in text)


def _renamed(data: bytes) -> bytes:
    """The file with colours under the name of any attribute, and points as triangles: what trimesh gives in full."""
    length = int.from_bytes(data[12:16], "little")
    if data[16:20] != _JSON:
        return data
    tree = json.loads(data[20 : 20 + length])
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            _rename(primitive["attributes"], _COLOR, _HIDDEN)
            if primitive.get("mode") == _POINTS:
                tree["accessors"].append({"componentType": _UNSIGNED_BYTE, "type": "SCALAR", "count": 3})
                primitive.update(mode=_TRIANGLES, indices=len(tree["accessors"]) - 1)
    return packed(tree, data[20 + length :])


def packed(tree: dict[str, Any], rest: bytes) -> bytes:
    """Return a GLB file of its JSON and of the chunks that follow it."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    size = (20 + len(text) + len(rest)).to_bytes(4, "little")
    return b"glTF\x02\0\0\0" + size + len(text).to_bytes(4, "little") + _JSON + text + rest


def _rename(names: dict[str, Any], old: str, new: str) -> None:
    if old in names:
        names[new] = names.pop(old)


def _attributes(parts: list[dict[str, Any]]) -> dict[str, Values]:
    """Attributes that all parts have in the same shape."""
    found: dict[str, Values] = {}
    for name, first in parts[0].items():
        values = [np.asarray(part[name]) for part in parts if name in part]
        if len(values) < len(parts) or any(one.shape[1:] != first.shape[1:] for one in values):
            continue
        joined = np.concatenate(values)
        if name == _HIDDEN:
            full = 1.0 if joined.dtype.kind == "f" else float(np.iinfo(joined.dtype).max)
            colors = to_srgb(joined / full)
            found["colors"] = colors if (colors[:, 3:] < 255).any() else colors[:, :3]
        else:
            found[name.lstrip("_").lower()] = joined[:, 0] if joined.shape[1:] == (1,) else joined
    return found


def write_glb(mesh: Mesh, path: Path) -> None:
    """Write one node with the mesh, its vertex normals and attributes, and a translation to the mesh's middle."""
    import trimesh

    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    matrix = np.eye(4)
    matrix[:3, 3] = middle
    attributes: dict[str, Any] = {
        f"_{name.upper()}": values.astype(np.float32) for name, values in mesh.attributes.items() if name != "colors"
    }
    if "colors" in mesh.attributes:
        light = to_linear(with_alpha(as_bytes(mesh.attributes["colors"])))
        attributes[_HIDDEN] = np.rint(light * np.iinfo(np.uint16).max).astype(np.uint16)
    part = trimesh.Trimesh(
        mesh.vertices - middle,
        mesh.faces,
        vertex_normals=mesh.vertex_normals(),
        vertex_attributes=attributes,
        process=False,
        validate=False,
    )
    scene: Any = trimesh.Scene()
    scene.add_geometry(part, node_name="mesh", transform=matrix)
    path.write_bytes(scene.export(file_type="glb", include_normals=True, tree_postprocessor=_finish))


def _finish(tree: dict[str, Any]) -> None:
    """Name the colours as glTF does, and give the mesh a matt material: without one, viewers take it for metal."""
    primitive = tree["meshes"][0]["primitives"][0]
    _rename(primitive["attributes"], _HIDDEN, _COLOR)
    if _COLOR in primitive["attributes"]:
        accessor = tree["accessors"][primitive["attributes"][_COLOR]]
        accessor["normalized"] = True
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}]
    primitive["material"] = 0


# glTF with its JSON in a text file, and its buffers inside of that or in files beside it: read as the GLB of the same.
#
# A GLB has one buffer, so all buffers are put in a row, and the views into them are moved.


def read_gltf(path: Path) -> Contents:
    """Read all meshes and clouds of the scene into one, as `read_glb` does.

    Raises
    ------
    InputError
        When the file is malformed, holds no vertices, or a buffer is missing.
    """
    with parsing("glTF"):
        tree = json.loads(path.read_bytes())
        buffers = [_buffer(one["uri"], path.parent) for one in tree.get("buffers", [])]
        starts = [0]
        for buffer in buffers:
            starts.append(starts[-1] + len(buffer) + -len(buffer) % 4)
        for view in tree.get("bufferViews", []):
            view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
            view["buffer"] = 0
        data = packed(_with_one_buffer(tree, starts[-1]), _chunk(buffers))
    return read_glb_bytes(data)


def _with_one_buffer(tree: dict[str, Any], size: int) -> dict[str, Any]:
    return {**tree, "buffers": [{"byteLength": size}]}


def _chunk(buffers: list[bytes]) -> bytes:
    body = b"".join(buffer + b"\0" * (-len(buffer) % 4) for buffer in buffers)
    return len(body).to_bytes(4, "little") + b"BIN\0" + body


def _buffer(uri: str, folder: Path) -> bytes:
    """The bytes of a data URI, or of a file in or below the scene's folder."""
    if uri.startswith("data:"):
        return binascii.a2b_base64(uri.partition(",")[2])
    target = beside(folder, unquote(uri), "buffer")
    if not target.is_file():
        raise InputError(f"the buffer {uri[:80]!r} is missing beside the file.")
    return target.read_bytes()
