"""Every cloud format gives back what its file says, with all digits."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import read_cloud, read_mesh, read_reference

UTM = np.array([[431234.123456789, 5412345.987654321, 312.1], [431235.000000001, 5412346.5, 313.25], [0.1, -2e5, 7.0]])


def save(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def rows(table: np.ndarray, separator: str = " ") -> str:
    return "".join(separator.join(repr(float(value)) for value in row) + "\n" for row in table)


def ply(encoding: str, body: bytes, properties: str, count: int, more: str = "") -> bytes:
    start = f"ply\nformat {encoding} 1.0\ncomment made here\nobj_info x 1\nelement vertex {count}\n"
    return f"{start}{properties}{more}end_header\n".encode() + body


DOUBLES = "property double x\nproperty double y\nproperty double z\n"


def test_ply_ascii_keeps_all_digits_even_of_floats(tmp_path: Path) -> None:
    path = save(tmp_path, "a.ply", ply("ascii", rows(UTM).encode(), DOUBLES.replace("double", "float"), 3))
    np.testing.assert_array_equal(read_cloud(path).points, UTM)


@pytest.mark.parametrize(("encoding", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_ply_binary_keeps_doubles_normals_colours_and_scalars(tmp_path: Path, encoding: str, order: str) -> None:
    kinds = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue"), ("float", "intensity"), ("ushort", "label")]
    properties = DOUBLES + "".join(f"property float n{axis}\n" for axis in "xyz")
    properties += "".join(f"property {kind} {name}\n" for kind, name in kinds)
    body = b"".join(struct.pack(f"{order}3d3f3BfH", *point, 0, 0, 1, 10, 20, 30, 0.5, 40000) for point in UTM)
    cloud = read_cloud(save(tmp_path, "a.ply", ply(encoding, body, properties, 3)))
    np.testing.assert_array_equal(cloud.points, UTM)
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1]] * 3)
    np.testing.assert_array_equal(cloud.attributes["colors"], [[10, 20, 30]] * 3)
    assert cloud.attributes["colors"].dtype == np.uint8
    assert cloud.attributes["intensity"].tolist() == [0.5] * 3
    assert cloud.attributes["label"].tolist() == [40000] * 3
    assert set(cloud.attributes) == {"colors", "intensity", "label"}


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_ply_polygons_of_mixed_size_become_fans(tmp_path: Path, order: str) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 2, 2.0]])
    more = "element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\n"
    if order:
        body = b"".join(struct.pack(f"{order}3d", *point) for point in points)
        body += struct.pack(f"{order}BB4i", 9, 4, 0, 1, 2, 3) + struct.pack(f"{order}BB3i", 9, 3, 0, 1, 4)
    else:
        body = rows(points).encode() + b"9 4 0 1 2 3\n9 3 0 1 4\n"
    encoding = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    mesh = read_mesh(save(tmp_path, "a.ply", ply(encoding, body, DOUBLES, 5, more)))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 4]])


def test_ply_ignores_what_follows_vertices_and_faces(tmp_path: Path) -> None:
    more = "element range_grid 3\nproperty list uchar int vertex_indices\n"
    path = save(tmp_path, "a.ply", ply("ascii", rows(UTM).encode() + b"1 0\n0\n1 1\n", DOUBLES, 3, more))
    cloud = read_cloud(path)
    assert len(cloud) == 3
    assert cloud.normals is None


def test_mesh_without_normals_gives_area_weighted_ones_and_zero_where_no_face_is(tmp_path: Path) -> None:
    path = save(tmp_path, "a.off", "OFF\n4 1 0\n0 0 0\n1 0 0\n0 1 0\n5 5 5\n3 0 1 2\n")
    np.testing.assert_array_equal(read_cloud(path).normals, [[0, 0, 1]] * 3 + [[0, 0, 0]])


def pcd(data: str, body: bytes) -> bytes:
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 8 8 8 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 3\n"
    return (header + f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA {data}\n").encode() + body


def test_pcd_ascii_and_binary_keep_doubles_and_intensity(tmp_path: Path) -> None:
    text = rows(np.column_stack([UTM, [0.5, 1, 2]])).encode()
    binary = b"".join(struct.pack("<3df", *point, level) for point, level in zip(UTM, [0.5, 1, 2], strict=True))
    for name, content in [("a.pcd", pcd("ascii", text)), ("b.pcd", pcd("binary", binary))]:
        cloud = read_cloud(save(tmp_path, name, content))
        np.testing.assert_array_equal(cloud.points, UTM)
        assert cloud.attributes["intensity"].tolist() == [0.5, 1, 2]


def test_pcd_compressed_keeps_doubles(tmp_path: Path) -> None:
    import open3d

    stored = open3d.t.geometry.PointCloud(open3d.core.Tensor(UTM))
    assert open3d.t.io.write_point_cloud(tmp_path / "c.pcd", stored, compressed=True)
    assert b"binary_compressed" in (tmp_path / "c.pcd").read_bytes()
    np.testing.assert_array_equal(read_cloud(tmp_path / "c.pcd").points, UTM)


@pytest.mark.parametrize(
    "text",
    [
        rows(UTM),
        rows(UTM, ","),
        rows(UTM, " , "),
        rows(UTM, "\t"),
        rows(UTM, ";"),
        rows(UTM, ";").replace(".", ","),
        "# made by a scanner\n\n" + rows(UTM),
        "// a comment\r\n" + rows(UTM).replace("\n", "\r\n"),
        "\ufeffx,y,z\n" + rows(UTM, ","),
        "//X Y Z\n" + rows(UTM),
        '"X";"Y";"Z"\n' + rows(UTM, ";"),
        "3\n" + rows(UTM),
    ],
)
def test_text_tables_of_every_dialect(tmp_path: Path, text: str) -> None:
    for suffix in ("xyz", "txt", "csv", "pts"):
        cloud = read_cloud(save(tmp_path, f"a.{suffix}", text))
        np.testing.assert_array_equal(cloud.points, UTM)
        assert cloud.normals is None


UNIT = np.array([[0, 0, 1.0], [0.6, 0.8, 0], [-1, 0, 0]])
COLOR = np.array([[255, 0, 7.0], [1, 2, 3], [80, 90, 100]])
LEVEL = np.array([[0.1], [0.2], [0.3]])


@pytest.mark.parametrize(
    ("blocks", "names"),
    [
        ([LEVEL], ["intensity"]),
        ([UNIT], ["normals"]),
        ([COLOR], ["colors"]),
        ([LEVEL, COLOR], ["intensity", "colors"]),
        ([UNIT, LEVEL], ["normals", "intensity"]),
        ([UNIT, COLOR], ["normals", "colors"]),
        ([COLOR, UNIT], ["colors", "normals"]),
        ([LEVEL, LEVEL], ["column_4", "column_5"]),
    ],
)
def test_columns_without_names_are_guessed(tmp_path: Path, blocks: list[np.ndarray], names: list[str]) -> None:
    cloud = read_cloud(save(tmp_path, "a.xyz", rows(np.column_stack([UTM, *blocks]))))
    found = {**cloud.attributes, **({} if cloud.normals is None else {"normals": cloud.normals})}
    assert set(found) == set(names)
    for name, block in zip(names, blocks, strict=True):
        np.testing.assert_array_equal(found[name].reshape(3, -1), block)


def test_named_columns_may_come_in_any_order(tmp_path: Path) -> None:
    table = np.column_stack([LEVEL, UNIT, UTM, COLOR])
    cloud = read_cloud(save(tmp_path, "a.csv", "Intensity,nx,ny,nz,X,Y,Z,R,G,B\n" + rows(table, ",")))
    np.testing.assert_array_equal(cloud.points, UTM)
    np.testing.assert_array_equal(cloud.normals, UNIT)
    np.testing.assert_array_equal(cloud.attributes["colors"], COLOR)
    np.testing.assert_array_equal(cloud.attributes["Intensity"], LEVEL[:, 0])


def test_rows_with_nan_pass(tmp_path: Path) -> None:
    assert np.isnan(read_cloud(save(tmp_path, "a.xyz", "0 0 0\nnan 1 1\n")).points[1, 0])


def test_obj_relative_indices_and_mixed_corners(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nvt 0 0\nvn 0 0 2\nf -4/1/-1 -2/1/-1 -1/1/-1\n"
    np.testing.assert_array_equal(read_mesh(save(tmp_path, "a.obj", text)).faces, [[0, 1, 2], [0, 2, 3]])


def test_obj_keeps_one_vertex_where_normals_differ(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 1\nvn 1 0 0\nf 1//1 2//1 3//1\nf 1//2 3//2 4//2\n"
    mesh = read_mesh(save(tmp_path, "a.obj", text))
    assert len(mesh.vertices) == 4
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals[0], np.array([1, 0, 1]) / np.sqrt(2))


@pytest.mark.parametrize("corner", ["{}", "{}/1", "{0}//{0}", "{0}/1/{0}"])
def test_obj_faces_do_not_depend_on_how_corners_are_written(tmp_path: Path, corner: str) -> None:
    vertices = "".join(f"v {x} {y} 0\nvn 0 {x} 1\n" for x in range(3) for y in range(2))
    faces = [[1, 2, 3], [2, 4, 3], [3, 4, 5], [4, 6, 5]]
    lines = ["\tf " + "  ".join(corner.format(vertex) for vertex in face) + " # face" for face in faces]
    mesh = read_mesh(save(tmp_path, "a.obj", vertices + "vt 0 0\n" + "\n".join(lines)))
    np.testing.assert_array_equal(mesh.faces, np.array(faces) - 1)
    assert (mesh.normals is None) == (corner in ("{}", "{}/1"))


def test_obj_line_of_six_corners_is_one_polygon(tmp_path: Path) -> None:
    vertices = "".join(f"v {np.cos(k)} {np.sin(k)} 0\n" for k in range(6))
    mesh = read_mesh(save(tmp_path, "a.obj", vertices + "f 1 2 3 4 5 6\n"))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])


def test_obj_points_carry_colours(tmp_path: Path) -> None:
    cloud = read_cloud(save(tmp_path, "a.obj", "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\n"))
    np.testing.assert_array_equal(cloud.attributes["colors"], [[1, 0, 0], [0, 1, 0]])


def test_off_variants(tmp_path: Path) -> None:
    text = "CNOFF 3 1 0 # counts\n" + "".join(f"{x} 0 {x * x} 0 0 1 9 8 7\n" for x in (0, 1, 2)) + "3 0 1 2 255 0 0\n"
    cloud = read_cloud(save(tmp_path, "a.off", text))
    np.testing.assert_array_equal(cloud.points, [[0, 0, 0], [1, 0, 1], [2, 0, 4]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1]] * 3)
    np.testing.assert_array_equal(cloud.attributes["colors"], [[9, 8, 7]] * 3)


def test_stl_text_merges_equal_corners_in_order(tmp_path: Path) -> None:
    facet = "facet normal 0 0 1\nouter loop\nvertex {}\nvertex {}\nvertex {}\nendloop\nendfacet\n"
    solid = facet.format("5 0 0", "1 0 0", "0 1 0") + facet.format("0 1 0", "1 0 0", "1 1 0")
    mesh = read_mesh(save(tmp_path, "a.stl", f"solid a\n{solid}endsolid a\n"))
    np.testing.assert_array_equal(mesh.vertices, [[5, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [2, 1, 3]])


def test_format_overrules_the_extension(tmp_path: Path) -> None:
    path = save(tmp_path, "scan.dat", rows(UTM))
    for name in ("xyz", ".xyz", "XYZ"):
        np.testing.assert_array_equal(read_cloud(path, name).points, UTM)


def test_reference_is_a_mesh_where_there_are_faces(tmp_path: Path) -> None:
    assert isinstance(read_reference(save(tmp_path, "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")), Mesh)
    assert len(read_reference(save(tmp_path, "b.obj", "v 0 0 0\nv 1 0 0\n")).points) == 2  # type: ignore[union-attr]
