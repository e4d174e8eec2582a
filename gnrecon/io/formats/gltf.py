"""glTF 2.0, binary (GLB) and in text, by trimesh (specification: https://registry.khronos.org/glTF).

glTF stores float32. Positions are therefore stored relative to the middle of the mesh's bounding box, and the node's
matrix, whose numbers are JSON text with all digits, holds the offset.

Vertex colours are linear light in glTF, for which 8 bits are too coarse in dark tones, so they are written and read as
16-bit numbers. trimesh supports only 8 bits, so it gets them as a custom attribute, ``_COLOR_0``, which is renamed to
and from ``COLOR_0`` in the file's JSON. All other attributes are float32, and their names begin with an underscore.

trimesh reads only the positions of point clouds. They are therefore passed to it as a mesh of one triangle that uses
the first point three times: its indices are an accessor without a buffer, whose values are zero by the specification.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from gnrecon.geometry.arrays import Values
from gnrecon.geometry.colors import as_bytes, to_linear, to_srgb, with_alpha
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, concatenated, guard_parser, without_opaque_alpha
from gnrecon.io.parse import require_buildable, sibling_path
from gnrecon.runtime.errors import InputError
from gnrecon.runtime.logs import unprinted_log
from gnrecon.runtime.quiet_imports import import_uninterrupted


def glb_supports(name: str, values: Values) -> bool:
    """Whether glTF can store an attribute: finite numbers of up to four columns that float32 keeps apart."""
    if name == "colors":
        return True
    if values.dtype.kind not in "biuf" or values.ndim > 2 or (values.ndim == 2 and values.shape[1] > 4):
        return False
    numbers = values.astype(np.float64)
    with np.errstate(over="ignore"):  # what overflows is not supported
        single = numbers.astype(np.float32)
    return bool(np.isfinite(single).all()) and (values.dtype.kind == "f" or bool((single == numbers).all()))


def read_gltf(path: Path) -> Contents:
    """Read all meshes and clouds of the scene, of a text or GLB file, into one, each moved by its node's matrix.

    Attributes are kept where all meshes have them, with their names in lower case.
    """
    trimesh = import_uninterrupted("trimesh")
    data = path.read_bytes()
    with guard_parser("glTF or GLB"), unprinted_log("trimesh"):
        text, chunk = data, b""
        if data.startswith(b"glTF"):
            # 12 bytes of header, 4 for the length of the JSON, 4 for its type, the JSON, 8 bytes, and the buffer.
            end = 20 + int.from_bytes(data[12:16], "little")
            text, chunk = data[20:end], data[end + 8 :]
        tree = json.loads(text)
        buffers: dict[str, bytes] = {}
        for buffer in tree.get("buffers", []):
            uri = buffer.setdefault("uri", "")
            if not uri.startswith("data:"):
                buffers[uri] = _buffer(uri, path.parent) if uri else chunk
                if len(buffers[uri]) < int(buffer["byteLength"]):
                    raise InputError(f"a buffer ends after {len(buffers[uri])} of {buffer['byteLength']} bytes.")
        _prepare(tree, len(data) + sum(map(len, buffers.values())))
        file = trimesh.util.wrap_as_stream(json.dumps(tree))
        scene = trimesh.load_scene(file, file_type="gltf", resolver=buffers, process=False, skip_materials=True)
        names = {"TEXCOORD_0": "texture coordinates"} | {name: name for name in ("textures", "animations", "skins")}
        unread = tuple(name for word, name in names.items() if f'"{word}"'.encode() in text)
        return _collected(scene, unread)


def _buffer(uri: str, folder: Path) -> bytes:
    """The bytes of a file in or below the scene's folder."""
    target = sibling_path(folder, unquote(uri), "buffer")
    if not target.is_file():
        raise InputError(f"the buffer {uri[:80]!r} is missing from the file's folder.")
    return target.read_bytes()


def _collected(scene: Any, unread: tuple[str, ...]) -> Contents:
    """All meshes and clouds of a scene, in one."""
    pieces = []
    for matrix, name in (scene.graph[node] for node in scene.graph.nodes_geometry):
        part = scene.geometry[name]
        faces = np.asarray(part.faces, np.int64)
        faces = faces[:0] if np.array_equal(faces, [[0, 0, 0]]) else faces
        # A mirroring matrix would turn faces inside out, so their corners are reversed.
        faces = faces if np.linalg.det(matrix[:3, :3]) > 0 else faces[:, ::-1]
        # Normals transform by the inverse transpose of the matrix, which for row vectors is a product with the inverse.
        normals = np.asarray(part.vertex_normals) @ np.linalg.inv(matrix[:3, :3])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
        points = np.asarray(part.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
        pieces.append(Contents(points, normals, faces, _attributes(part.vertex_attributes)))
    found = concatenated(pieces)
    if not len(found.points):
        raise InputError("the file holds no vertices.")
    given = found.normals if found.normals is not None and found.normals.any() else None
    held = without_opaque_alpha(found.attributes)
    return replace(found, normals=given, attributes=held, unread=unread + found.unread)


def _prepare(tree: dict[str, Any], size: int) -> None:
    """Make colours a custom attribute, and points triangles, so that trimesh reads both in full."""
    _require_bounded(tree, size)
    for primitive in (primitive for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]):
        if "COLOR_0" in (names := primitive["attributes"]):
            names["_COLOR_0"] = names.pop("COLOR_0")
        if primitive.get("mode") == 0:  # points; mode 4 is triangles, component type 5121 is unsigned bytes
            tree["accessors"].append({"componentType": 5121, "type": "SCALAR", "count": 3})
            primitive.update(mode=4, indices=len(tree["accessors"]) - 1)


def _require_bounded(tree: dict[str, Any], size: int, *, most_parts: int = 10_000) -> None:
    """Refuse counts that the file's bytes cannot hold, before trimesh allocates arrays of their size."""
    views = tree.get("bufferViews", [])
    zeros = 0
    for accessor in tree.get("accessors", []):
        if "sparse" in accessor:
            raise InputError("an accessor is sparse, which is not supported; store its values in full.")
        # Without a view, the values are zero; a file that uses them has at least as many bytes.
        view, count = accessor.get("bufferView"), int(accessor["count"])
        zeros += count if view is None else 0
        held = size if view is None else min(size, int(views[view]["byteLength"]))
        if not 0 <= count <= held or zeros > size:
            raise InputError(f"an accessor declares {count} values, more than the file holds.")
    meshes, used = tree.get("meshes", []), _nodes_with_meshes(tree)
    numbers = [sum(_numbers(tree, primitive) for primitive in mesh["primitives"]) for mesh in meshes]
    parts = sum(len(meshes[mesh]["primitives"]) for mesh in used)
    require_buildable(parts, sum(numbers[mesh] for mesh in used), size, most_parts)


def _nodes_with_meshes(tree: dict[str, Any], *, most_steps: int = 500_000) -> list[int]:
    """The mesh of each node that has one. trimesh walks up from each to the root, some 30 microseconds a step."""
    nodes = tree.get("nodes", [])
    children = [node.get("children", []) for node in nodes]
    inner = {child for row in children for child in row}
    depth = {root: 1 for root in range(len(nodes)) if root not in inner}
    waiting = list(depth)
    while waiting:
        parent = waiting.pop()
        new = [child for child in dict.fromkeys(children[parent]) if child not in depth]
        depth.update(dict.fromkeys(new, depth[parent] + 1))
        waiting += new
    found = [place for place, node in enumerate(nodes) if "mesh" in node]
    if sum(depth.get(place, 1) for place in found) > most_steps:
        raise InputError("the nodes of the scene are nested too deep.")
    return [nodes[place]["mesh"] for place in found]


def _numbers(tree: dict[str, Any], primitive: dict[str, Any]) -> int:
    """Coordinates, indices and attributes' values of a part of a mesh."""
    places = [*primitive["attributes"].values(), *([primitive["indices"]] if "indices" in primitive else [])]
    columns, accessors = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}, [tree["accessors"][place] for place in places]
    return sum(columns.get(accessor["type"], 4) * int(accessor["count"]) for accessor in accessors)


def _attributes(stored: dict[str, Any]) -> dict[str, Values]:
    """The attributes of one mesh by their names in lower case; colours in sRGB, of shape (N, 3 or 4)."""
    found: dict[str, Values] = {}
    for name, values in stored.items():
        column = np.asarray(values)
        if name == "_COLOR_0":
            full = 1.0 if column.dtype.kind == "f" else float(np.iinfo(column.dtype).max)
            found["colors"] = with_alpha(to_srgb(column / full))
        else:
            found[name.lstrip("_").lower()] = column[:, 0] if column.shape[1:] == (1,) else column
    return found


def write_glb(mesh: Mesh, path: Path) -> None:
    """Write one node with the mesh, its vertex normals and attributes, and a translation to the mesh's middle."""
    trimesh = import_uninterrupted("trimesh")
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    matrix = np.eye(4)
    matrix[:3, 3] = middle
    others = {name: values for name, values in mesh.attributes.items() if name != "colors"}
    attributes: dict[str, Any] = {f"_{name.upper()}": values.astype(np.float32) for name, values in others.items()}
    if "colors" in mesh.attributes:
        light = to_linear(with_alpha(as_bytes(mesh.attributes["colors"])))
        attributes["_COLOR_0"] = np.rint(light * np.iinfo(np.uint16).max).astype(np.uint16)
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
    path.write_bytes(scene.export(file_type="glb", include_normals=True, tree_postprocessor=_set_colors_and_material))


def _set_colors_and_material(tree: dict[str, Any]) -> None:
    """Give the colours their glTF name, and the mesh a matt material: without one, viewers draw it as metal."""
    primitive = tree["meshes"][0]["primitives"][0]
    if "_COLOR_0" in (names := primitive["attributes"]):
        names["COLOR_0"] = names.pop("_COLOR_0")
        tree["accessors"][names["COLOR_0"]]["normalized"] = True
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}]
    primitive["material"] = 0
