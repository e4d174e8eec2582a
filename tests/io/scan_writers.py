"""Writers of clouds for the tests, one for each format that is read: by this package, by another library, or by hand.

A writer takes a cloud whose coordinates are multiples of 1/1024 below 1,000 in size, which every format holds exactly,
with float32 normals, 8-bit colours and an integer ``intensity``.
"""

from __future__ import annotations

import base64
import gzip
import json
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import write_cloud
from gnrecon.io.formats.table import write_table

Float = npt.NDArray[np.float64]

EVERYTHING = frozenset({"normals", "colors", "intensity"})


@dataclass(frozen=True)
class Form:
    """One way of writing a cloud.

    Parameters
    ----------
    suffix : of the file
    write : the writer
    holds : what it keeps besides positions
    """

    suffix: str
    write: Callable[[PointCloud, Path], None]
    holds: frozenset[str] = EVERYTHING


def random_cloud(rng: np.random.Generator, count: int) -> PointCloud:
    """A cloud of unlike points that every format can hold."""
    places = rng.choice(2_000_000, (count, 3), replace=False) / 1024 - 900
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = rng.integers(1, 256, (count, 3)).astype(np.uint8)
    colors[0] = 255  # so that no format can take the scale for another
    return PointCloud(places, normals, {"colors": colors, "intensity": rng.integers(1, 5000, count).astype(np.uint16)})


def _ours(cloud: PointCloud, path: Path) -> None:
    write_cloud(cloud, path, overwrite=True)


def _ascii_ply(cloud: PointCloud, path: Path) -> None:
    assert cloud.normals is not None
    names = [*(f"double {a}" for a in "xyz"), *(f"float n{a}" for a in "xyz"), "uchar red", "uchar green", "uchar blue"]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(cloud)}\n"
    header += "".join(f"property {name}\n" for name in [*names, "ushort intensity"]) + "end_header\n"
    path.write_text(header + _lines(cloud.points, cloud.normals, cloud.attributes["colors"], _column(cloud)))


def _column(cloud: PointCloud) -> npt.NDArray[np.generic]:
    return cloud.attributes["intensity"][:, None]


def _lines(*blocks: npt.NDArray[np.generic]) -> str:
    rows = zip(*(block.tolist() for block in blocks), strict=True)
    return "".join(" ".join(repr(value) for part in row for value in part) + "\n" for row in rows)


def _pcd(cloud: PointCloud, path: Path) -> None:
    import open3d

    tensor = open3d.core.Tensor
    stored = open3d.t.geometry.PointCloud(tensor(cloud.points))
    stored.point["normals"] = tensor(cloud.normals)
    stored.point["colors"] = tensor(cloud.attributes["colors"])
    stored.point["intensity"] = tensor(_column(cloud).astype(np.float64))
    assert open3d.t.io.write_point_cloud(str(path), stored)


def _obj(cloud: PointCloud, path: Path) -> None:
    colors = cloud.attributes["colors"] / 255
    path.write_text("".join(f"v {line}\n" for line in _lines(cloud.points, colors).splitlines()))


def _off(cloud: PointCloud, path: Path) -> None:
    assert cloud.normals is not None
    path.write_text(f"NOFF\n{len(cloud)} 0 0\n" + _lines(cloud.points, cloud.normals))


def _las(cloud: PointCloud, path: Path) -> None:
    import laspy

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, 1 / 1024), np.array([431000.0, 0, 0]) * 0
    extra = [laspy.ExtraBytesParams(name, "f8") for name in ("NormalX", "NormalY", "NormalZ")]
    header.add_extra_dims(extra)
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.attributes["colors"].T
    las.intensity = cloud.attributes["intensity"]
    assert cloud.normals is not None
    for name, values in zip(("NormalX", "NormalY", "NormalZ"), cloud.normals.T, strict=True):
        las[name] = values
    las.write(str(path))


TURN = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [128, -64, 32, 1]])
"""A pose that loses no digit: a third of a turn about (1, 1, 1), then a translation."""


def _ptx(cloud: PointCloud, path: Path) -> None:
    own = (cloud.points - TURN[3, :3]) @ TURN[:3, :3].T
    rows = _lines(own, _column(cloud), cloud.attributes["colors"])
    head = f"{len(cloud)}\n2\n" + _lines(TURN[[3, 0, 1, 2], :3]) + _lines(TURN)
    path.write_text(head + "".join(f"{line}\n0 0 0 0.5 0 0 0\n" for line in rows.splitlines()))


def _e57(cloud: PointCloud, path: Path) -> None:
    import pye57

    own = (cloud.points - TURN[3, :3]) @ TURN[:3, :3].T
    fields = {f"cartesian{axis}": np.ascontiguousarray(values) for axis, values in zip("XYZ", own.T, strict=True)}
    names = ("colorRed", "colorGreen", "colorBlue")
    fields |= {n: np.ascontiguousarray(v) for n, v in zip(names, cloud.attributes["colors"].T, strict=True)}
    fields["intensity"] = cloud.attributes["intensity"].astype(np.float32)
    rotation, translation = np.full(4, 0.5), TURN[3, :3]
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw(fields, rotation=rotation, translation=translation)
    file.close()


def _vtk(binary: bool, version: str = "3.0") -> Callable[[PointCloud, Path], None]:
    def write(cloud: PointCloud, path: Path) -> None:
        def block(values: npt.NDArray[np.generic]) -> bytes:
            if not binary:
                return _lines(values).encode()
            return values.astype(values.dtype.newbyteorder(">")).tobytes() + b"\n"

        assert cloud.normals is not None
        count, kind = len(cloud), "BINARY" if binary else "ASCII"
        data = f"# vtk DataFile Version {version}\nmade for a test\n{kind}\nDATASET POLYDATA\nPOINTS {count} double\n"
        content = data.encode() + block(cloud.points)
        content += f"POINT_DATA {count}\nNORMALS directions double\n".encode() + block(cloud.normals)
        content += b"METADATA\nCOMPONENT_NAMES\nX\n\n" if version == "5.1" else b""
        content += f"FIELD FieldData 2\nseen 3 {count} unsigned_char\n".encode() + block(cloud.attributes["colors"])
        content += f"intensity 1 {count} unsigned_short\n".encode() + block(_column(cloud))
        path.write_bytes(content)

    return write


def _vtp(form: str, compressed: bool = False, kind: str = "PolyData") -> Callable[[PointCloud, Path], None]:
    def write(cloud: PointCloud, path: Path) -> None:
        assert cloud.normals is not None
        appended = b""

        def stored(values: npt.NDArray[np.generic], encode: bool) -> bytes:
            data = values.tobytes()
            if not compressed:
                head = struct.pack("<Q", len(data))
                return base64.b64encode(head + data) if encode else head + data
            blocks = [zlib.compress(data[start : start + 64]) for start in range(0, len(data), 64)]
            head = struct.pack(f"<{3 + len(blocks)}Q", len(blocks), 64, len(data) % 64, *map(len, blocks))
            body = b"".join(blocks)
            return base64.b64encode(head) + base64.b64encode(body) if encode else head + body

        def array(name: str, kind: str, values: npt.NDArray[np.generic]) -> bytes:
            nonlocal appended
            columns = 1 if values.ndim == 1 else values.shape[1]
            head = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{columns}"'.encode()
            if form == "ascii":
                text = _lines(values.reshape(len(values), -1)).encode()
                return head + b' format="ascii">' + text + b"</DataArray>"
            if form == "binary":
                return head + b' format="binary">' + stored(values, True) + b"</DataArray>"
            start = len(appended)
            appended += stored(values, form == "base64")
            return head + f' format="appended" offset="{start}"/>'.encode()

        count = len(cloud)
        head = f'<?xml version="1.0"?><VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" '
        head += 'header_type="UInt64"' + (' compressor="vtkZLibDataCompressor"' if compressed else "")
        content = (head + f'><{kind}><Piece NumberOfPoints="{count}"><PointData Normals="n">').encode()
        content += array("n", "Float64", cloud.normals) + array("rgb", "UInt8", cloud.attributes["colors"])
        content += array("intensity", "UInt16", cloud.attributes["intensity"]) + b"</PointData><Points>"
        content += array("Points", "Float64", cloud.points) + f"</Points></Piece></{kind}>".encode()
        if appended:
            encoding = "base64" if form == "base64" else "raw"
            content += f'<AppendedData encoding="{encoding}">_'.encode() + appended + b"</AppendedData>"
        path.write_bytes(content + b"</VTKFile>")

    return write


def _gltf_tree(cloud: PointCloud) -> tuple[dict[str, object], bytes]:
    from gnrecon.geometry.colors import to_linear

    light = np.rint(65535 * to_linear(cloud.attributes["colors"])).astype("<u2")
    assert cloud.normals is not None
    blocks = [cloud.points.astype("<f4"), cloud.normals.astype("<f4"), np.pad(light, ((0, 0), (0, 1)))[:, :3]]
    blocks.append(cloud.attributes["intensity"].astype("<f4"))
    parts = [np.ascontiguousarray(block).tobytes() for block in blocks]
    parts = [part + b"\0" * (-len(part) % 4) for part in parts]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    count = len(cloud)
    kinds = [(5126, "VEC3"), (5126, "VEC3"), (5123, "VEC3"), (5126, "SCALAR")]
    tree: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "cloud"}],
        "meshes": [
            {
                "primitives": [
                    {"mode": 0, "attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2, "_INTENSITY": 3}},
                ]
            }
        ],
        "accessors": [
            {"bufferView": i, "componentType": kind, "type": shape, "count": count, "normalized": kind == 5123}
            for i, (kind, shape) in enumerate(kinds)
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part)}
            for start, part in zip(starts, parts, strict=False)
        ],
    }
    return tree, b"".join(parts)


def _glb(cloud: PointCloud, path: Path) -> None:
    tree, body = _gltf_tree(cloud)
    text = json.dumps(tree | {"buffers": [{"byteLength": len(body)}]}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)


def _gltf(embedded: bool) -> Callable[[PointCloud, Path], None]:
    def write(cloud: PointCloud, path: Path) -> None:
        tree, body = _gltf_tree(cloud)
        half = len(cloud) * 12  # the positions in a buffer of their own
        uris = []
        for name, part in (("a b.bin", body[:half]), ("c.bin", body[half:])):
            (path.parent / name).write_bytes(part)
            coded = "data:application/octet-stream;base64," + base64.b64encode(part).decode()
            uris.append({"uri": coded if embedded else name.replace(" ", "%20"), "byteLength": len(part)})
        views = json.loads(json.dumps(tree["bufferViews"]))
        for view in views[1:]:
            view["buffer"], view["byteOffset"] = 1, view["byteOffset"] - half
        path.write_text(json.dumps(tree | {"buffers": uris, "bufferViews": views}))

    return write


def _zipped(write: Callable[[PointCloud, Path], None]) -> Callable[[PointCloud, Path], None]:
    def packed(cloud: PointCloud, path: Path) -> None:
        inner = path.with_suffix("")
        write(cloud, inner)
        path.write_bytes(gzip.compress(inner.read_bytes(), mtime=0))

    return packed


def _table(cloud: PointCloud, path: Path) -> None:
    write_table(Mesh(cloud.points, np.empty((0, 3), int), cloud.normals, cloud.attributes), path)


def _npy(cloud: PointCloud, path: Path) -> None:
    assert cloud.normals is not None
    names = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "intensity"]
    blocks = [cloud.points, cloud.normals, cloud.attributes["colors"], cloud.attributes["intensity"][:, None]]
    rows = [tuple(row) for row in np.hstack(blocks)]
    kinds = ["f8"] * 6 + ["u1"] * 3 + [cloud.attributes["intensity"].dtype.str]
    np.save(path, np.array(rows, list(zip(names, kinds, strict=True))))


def _npz(cloud: PointCloud, path: Path) -> None:
    np.savez(path, points=cloud.points, normals=cloud.normals, **cloud.attributes)


FORMS = {
    "ply": Form(".ply", _ours),
    "ply-text": Form(".ply", _ascii_ply),
    "pcd": Form(".pcd", _pcd),
    "xyz": Form(".xyz", _ours),
    "txt": Form(".txt", _ours),
    "csv": Form(".csv", _ours),
    "pts": Form(
        ".pts", lambda cloud, path: path.write_text(f"{len(cloud)}\n" + _lines(cloud.points)) and None, frozenset()
    ),
    **{suffix: Form(f".{suffix}", _table) for suffix in ("asc", "dat", "xyzn", "xyzrgb")},
    "npy": Form(".npy", _npy),
    "npz": Form(".npz", _npz),
    "obj": Form(".obj", _obj, frozenset({"colors"})),
    "off": Form(".off", _off, frozenset({"normals"})),
    "las": Form(".las", _las),
    "laz": Form(".laz", _las),
    "ptx": Form(".ptx", _ptx, frozenset({"colors", "intensity"})),
    "e57": Form(".e57", _e57, frozenset({"colors", "intensity"})),
    "vtk": Form(".vtk", _vtk(binary=True)),
    "vtk-text": Form(".vtk", _vtk(binary=False)),
    "vtk-5": Form(".vtk", _vtk(binary=True, version="5.1")),
    "vtp-text": Form(".vtp", _vtp("ascii")),
    "vtp-base64": Form(".vtp", _vtp("binary")),
    "vtp-compressed": Form(".vtp", _vtp("binary", compressed=True)),
    "vtp-raw": Form(".vtp", _vtp("raw")),
    "vtp-raw-compressed": Form(".vtp", _vtp("raw", compressed=True)),
    "vtp-appended": Form(".vtp", _vtp("base64")),
    "vtu": Form(".vtu", _vtp("raw", kind="UnstructuredGrid")),
    "vts": Form(".vts", _vtp("binary", kind="StructuredGrid")),
    "glb": Form(".glb", _glb),
    "gltf": Form(".gltf", _gltf(embedded=False)),
    "gltf-embedded": Form(".gltf", _gltf(embedded=True)),
    "xyz-gz": Form(".xyz.gz", _zipped(_ours)),
    "ply-gz": Form(".ply.gz", _zipped(_ours)),
}


def file_of(name: str, cloud: PointCloud, folder: Path) -> Path:
    """Write a cloud in the form of that name into a folder, and return the file."""
    path = folder / f"scan{FORMS[name].suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other libraries' writers
        FORMS[name].write(cloud, path)
    return path
