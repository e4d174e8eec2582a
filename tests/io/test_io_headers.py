"""Headers as programs write them: padding and case in PCD, old and odd PLY, comments in OBJ, grids in VTK, old LAZ."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import read_any, read_cloud, read_mesh, read_reference
from gnrecon.io.formats.pcd import read_pcd
from gnrecon.runtime.errors import InputError

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]])


def pcd(path: Path, keyword: str, fields: str, sizes: str, kinds: str, counts: str, rows: np.ndarray) -> Path:
    head = f"# .PCD v0.7\nVERSION 0.7\n{keyword} {fields}\nSIZE {sizes}\nTYPE {kinds}\nCOUNT {counts}\n"
    head += f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    path.write_bytes(head.encode() + rows.tobytes())
    return path


def test_pcd_with_padding_fields_of_nothing_upper_case_and_columns(tmp_path: Path) -> None:
    rows = np.zeros(4, [("p", "<f4", 3), ("pad", "u1", 4), ("i", "<f4"), ("more", "u1", 8), ("ring", "<u2")])
    rows["p"], rows["i"], rows["ring"], rows["pad"] = POINTS, [5, 6, 7, 8], [1, 2, 3, 4], 255
    words = ("4 4 4 1 4 1 2 1", "F F F U F U U U", "1 1 1 4 1 8 1 0")
    for keyword in ("FIELDS", "COLUMNS"):
        cloud = read_cloud(pcd(tmp_path / "a.pcd", keyword, "X Y Z _ intensity _ ring _", *words, rows))
        np.testing.assert_array_equal(cloud.points, POINTS)
        assert cloud.attributes["intensity"].tolist() == [5, 6, 7, 8]
        assert cloud.attributes["ring"].tolist() == [1, 2, 3, 4]
        assert set(cloud.attributes) == {"intensity", "ring"}


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_fields_of_several_numbers_are_kept_whole_or_named(encoding: str, tmp_path: Path) -> None:
    rows = np.zeros(4, [("p", "<f4", 3), ("v", "<f4", 3), ("k", "<u2", 2), ("last", "u1")])
    rows["p"], rows["v"], rows["k"], rows["last"] = POINTS, POINTS[::-1] + 7, [[1, 2], [3, 4], [5, 6], [7, 8]], 9
    path = pcd(tmp_path / "a.pcd", "FIELDS", "x y z velocity k last", "4 4 4 4 2 1", "F F F F U U", "1 1 1 3 2 1", rows)
    head, body = path.read_bytes().split(b"DATA binary\n")
    if encoding == "ascii":
        body = "".join(
            f"{' '.join(map(repr, np.r_[r['p'], r['v'], r['k'], r['last']].tolist()))}\n" for r in rows
        ).encode()
    if encoding == "binary_compressed":
        # Stored by fields, and packed as literal runs of at most 32 bytes.
        columns = [rows["p"][:, i] for i in range(3)] + [rows[name] for name in ("v", "k", "last")]
        plain = b"".join(column.tobytes() for column in columns)
        runs = [plain[i : i + 32] for i in range(0, len(plain), 32)]
        packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    path.write_bytes(head + f"DATA {encoding}\n".encode() + body)
    contents = read_pcd(path)
    np.testing.assert_array_equal(contents.points, POINTS)
    assert contents.attributes["last"].tolist() == [9] * 4
    if encoding == "binary_compressed":
        assert contents.attributes["velocity"].tolist() == rows["v"][:, 0].tolist()
        assert contents.unread == tuple(f"all but the first number of the field {name}" for name in ("velocity", "k"))
    else:
        np.testing.assert_array_equal(contents.attributes["velocity"], rows["v"])
        np.testing.assert_array_equal(contents.attributes["k"], rows["k"])
        assert contents.unread == ()


def test_ply_with_bool_and_points_and_cr(tmp_path: Path) -> None:
    lines = ["ply", "format ascii 1.0", "element point 4", "property double x", "property double y"]
    lines += ["property double z", "property bool used", "end_header"]
    lines += [f"{x!r} {y!r} {z!r} {k % 2}" for k, (x, y, z) in enumerate(POINTS.tolist())]
    for end in ("\n", "\r", "\r\n"):
        path = tmp_path / "a.ply"
        path.write_bytes((end.join(lines) + end).encode())
        cloud = read_cloud(path)
        np.testing.assert_array_equal(cloud.points, POINTS)
        assert cloud.attributes["used"].tolist() == [0, 1, 0, 1]


def test_ply_triangle_strips_are_a_scan_and_a_reference(tmp_path: Path) -> None:
    """The strip 0 1 2 3, and after -1 the strip 3 2 1, whose triangle faces the other way."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    head += "property float z\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    strips = np.array([8, 0, 1, 2, 3, -1, 3, 2, 1], "<i4")
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + POINTS.astype("<f4").tobytes() + strips.tobytes())
    assert len(read_cloud(path).points) == 4
    for mesh in (read_mesh(path), read_reference(path)):
        assert isinstance(mesh, Mesh)
        assert {tuple(np.roll(face, -face.argmin())) for face in mesh.faces} == {(0, 1, 2), (1, 3, 2), (1, 3, 2)}
        assert len(mesh.faces) == 3
    normals = read_mesh(path).face_vectors
    assert (normals[:, 2] > 0).all()


def test_obj_with_comments_in_lines_and_colours_of_some_vertices(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0 # first\nv 1 0 0#second\nv 0 1 0 1 0 0\nf 1 2 3 # face\n")
    shape, unread = read_any(path)
    np.testing.assert_array_equal(shape.vertices, POINTS[:3])
    assert shape.faces.tolist() == [[0, 1, 2]]
    assert "colors" not in shape.attributes
    assert unread == ("colours, which only some of the vertices have",)


@pytest.mark.parametrize(
    ("dataset", "expected"),
    [
        ("STRUCTURED_POINTS\nDIMENSIONS 2 2 1\nORIGIN 1 2 3\nSPACING 0.5 1 1", [[1, 2, 3], [1.5, 2, 3], [1, 3, 3]]),
        (
            "RECTILINEAR_GRID\nDIMENSIONS 2 2 1\nX_COORDINATES 2 float\n0 4\nY_COORDINATES 2 float\n1 2\n"
            "Z_COORDINATES 1 float\n7",
            [[0, 1, 7], [4, 1, 7], [0, 2, 7]],
        ),
        (
            "STRUCTURED_GRID\nDIMENSIONS 2 2 1\nPOINTS 4 float\n0 0 0 1 0 0 0 1 0 1 1 0",
            [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        ),
    ],
)
def test_vtk_grids_are_points(tmp_path: Path, dataset: str, expected: list[list[float]]) -> None:
    path = tmp_path / "a.vtk"
    values = "POINT_DATA 4\nSCALARS height float 1\nLOOKUP_TABLE default\n1 2 3 4\n"
    path.write_text(f"# vtk DataFile Version 3.0\ngrid\nASCII\nDATASET {dataset}\n{values}")
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points[:3], expected)
    assert cloud.attributes["height"].tolist() == [1, 2, 3, 4]


def test_faces_of_unstructured_vtk_grids_are_read_and_solids_named(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_text(
        "# vtk DataFile Version 3.0\ncells\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n"
        "0 0 0 1 0 0 0 1 0 1 1 0.5\nCELLS 3 14\n3 0 1 2\n4 0 1 3 2\n4 0 1 2 3\nCELL_TYPES 3\n5\n9\n10\n"
    )
    shape, unread = read_any(path)
    assert shape.faces.tolist() == [[0, 1, 2], [0, 1, 3], [0, 3, 2]]
    assert unread == ("1 cells that are no polygons",)


def test_old_laz_is_refused_with_a_way_out(tmp_path: Path) -> None:
    data = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    data.x, data.y, data.z = POINTS.T
    path = tmp_path / "a.laz"
    data.write(str(path))
    old = bytearray(path.read_bytes())
    place = old.find(b"laszip encoded") + 52
    assert old[place : place + 2] in (b"\2\0", b"\3\0")
    old[place : place + 2] = b"\1\0"
    path.write_bytes(old)
    with pytest.raises(InputError, match=r"before 2011.*laszip -i old.laz -o new.las"):
        read_cloud(path)


@pytest.mark.parametrize(("position", "normal"), [("<f8", "<f4"), ("<f4", "<f8"), ("<f4", "i1")])
def test_pcd_normals_may_differ_in_type_from_positions(position: str, normal: str, tmp_path: Path) -> None:
    """open3d reads the former wrongly, and writes beyond its memory for the second."""
    scale = 127 if normal == "i1" else 1
    directions = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, -1, 0], [0.8, 0.6, 0]])
    rows = np.zeros(4, [("p", position, 3), ("n", normal, 3)])
    rows["p"], rows["n"] = POINTS, np.rint(directions * scale) if scale > 1 else directions
    sizes = " ".join([str(np.dtype(position).itemsize)] * 3 + [str(np.dtype(normal).itemsize)] * 3)
    kinds = "F F F " + ("I I I" if scale > 1 else "F F F")
    path = pcd(tmp_path / "a.pcd", "FIELDS", "x y z normal_x normal_y normal_z", sizes, kinds, "1 1 1 1 1 1", rows)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_allclose(cloud.normals, directions, atol=0.01 if scale > 1 else 1e-7)
