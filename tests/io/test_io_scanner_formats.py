"""What is particular to the formats of scanners and of VTK: scales, poses, grids, deleted points, polygons, damage."""

from __future__ import annotations

import gzip
import io
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from scan_writers import file_of, random_cloud

from gnrecon.io import read_any, read_cloud, read_mesh
from gnrecon.runtime.errors import InputError, UsageError

UTM = np.array([[431234.123, 5412345.987, 312.1], [431235.001, 5412346.5, 313.25], [431233.5, 5412340.25, 300.0]])


def las(path: Path, points: np.ndarray, **fields: Any) -> Path:
    data = laspy.LasData(laspy.LasHeader(point_format=7, version="1.4"))
    data.header.scales, data.header.offsets = np.full(3, 1e-3), np.floor(points.min(axis=0))
    data.x, data.y, data.z = points.T
    for name, values in fields.items():
        setattr(data, name, values)
    data.write(str(path))
    return path


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_keeps_projected_coordinates_to_their_last_digit(tmp_path: Path, suffix: str) -> None:
    cloud = read_cloud(las(tmp_path / f"a.{suffix}", UTM, classification=[2, 6, 6], gps_time=[0.25, 0.5, 1e9]))
    np.testing.assert_allclose(cloud.points, UTM, atol=1e-9, rtol=0)
    assert cloud.attributes["classification"].tolist() == [2, 6, 6]
    assert cloud.attributes["gps_time"].tolist() == [0.25, 0.5, 1e9]
    assert set(cloud.attributes) == {"classification", "gps_time"}, "what was never filled in is left out"


def test_las_colours_of_8_and_of_16_bits(tmp_path: Path) -> None:
    for colors, kind in (([10, 255, 0], np.uint8), ([2570, 65535, 0], np.uint16)):
        cloud = read_cloud(las(tmp_path / "a.las", UTM, red=colors, green=colors, blue=colors))
        assert cloud.attributes["colors"].dtype == kind
        np.testing.assert_array_equal(cloud.attributes["colors"], np.column_stack([colors] * 3))


def test_las_points_marked_as_deleted_are_not_read(tmp_path: Path) -> None:
    cloud, unread = read_any(las(tmp_path / "a.las", UTM, withheld=[0, 1, 0], intensity=[5, 6, 7]))
    assert cloud.attributes["intensity"].tolist() == [5, 7]
    assert unread == ("points marked as withheld",)


@pytest.mark.parametrize(
    ("start", "form", "value", "sentence"),
    [
        (247, "Q", 2**40, "declares 1099511627776 points, but the file ends after 3"),
        (100, "I", 2**31, "contradict"),
        (96, "I", 2**31, "contradict"),
        (243, "I", 2**31, "extended records that lie beyond"),
        (94, "H", 3, "contradict"),
    ],
)
def test_las_headers_are_compared_with_the_size(
    tmp_path: Path, start: int, form: str, value: int, sentence: str
) -> None:
    path = las(tmp_path / "a.las", UTM)
    data = bytearray(path.read_bytes())
    struct.pack_into(f"<{form}", data, start, value)
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=sentence):
        read_cloud(path)


def test_laz_that_is_cut_short(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = las(tmp_path / "a.laz", np.random.default_rng(0).uniform(0, 100, (60_000, 3)))
    path.write_bytes(path.read_bytes()[:-5000])
    with pytest.raises(InputError, match=r"LAS or LAZ|compressed chunks"):
        read_cloud(path)
    assert capfd.readouterr() == ("", "")


def ptx(columns: int, rows: int, translation: list[float], body: str) -> str:
    position = " ".join(map(str, translation))
    pose = f"{position}\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n{position} 1\n"
    return f"{columns}\n{rows}\n{pose}{body}"


def test_ptx_scans_are_posed_and_keep_their_grid(tmp_path: Path) -> None:
    first = ptx(2, 2, [10, 0, 0], "1 0 0 0.1\n0 0 0 0.5\n0 2 0 0.2\n0 0 3 0.3\n")
    second = ptx(1, 1, [0, 0, 7], "1 1 1 0.4\n")
    path = tmp_path / "a.ptx"
    path.write_text(first + second)
    cloud = read_cloud(path)
    # The rows of the matrix are the images of the axes: x goes to y, y to -x.
    np.testing.assert_array_equal(cloud.points, [[10, 1, 0], [8, 0, 0], [10, 0, 3], [-1, 1, 8]])
    np.testing.assert_array_equal(cloud.origins, [[10, 0, 0]] * 3 + [[0, 0, 7]])
    assert cloud.attributes["intensity"].tolist() == [0.1, 0.2, 0.3, 0.4]
    assert cloud.attributes["column"].tolist() == [0, 1, 1, 0]
    assert cloud.attributes["row"].tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (ptx(2, 2, [0, 0, 0], "1 0 0 0.1\n"), "scan 1 ends before"),
        (ptx(10**9, 10**9, [0, 0, 0], "1 0 0 0.1\n"), "scan 1 ends before"),
        (ptx(1, 1, [0, 0, 0], "1 0 zero 0.1\n"), "not a row of numbers"),
        (ptx(1, 1, [0, 0, 0], "1 0 0\n"), "4 or 7 numbers"),
        (ptx(1, 1, [0, 0, 0], "1 0 0 1\n").replace("-1 0 0 0", "5 0 0 0"), "is not a pose"),
        (ptx(1, 1, [0, 0, 0], "1 0 0 1\n").replace("-1 0 0 0", "1 0 0"), "lacks the four lines"),
        ("hello\n", "begins with 'hello'"),
    ],
)
def test_damaged_ptx(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.ptx").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_cloud(tmp_path / "a.ptx")


VTK = "# vtk DataFile Version {}\na title\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n0 0 0 1 0 0\n1 1 0 0 1 0\n"


@pytest.mark.parametrize(
    ("version", "cells", "faces"),
    [
        ("2.0", "POLYGONS 2 9\n4 0 1 2 3\n3 0 1 2\n", [[0, 1, 2], [0, 2, 3], [0, 1, 2]]),
        ("2.0", "TRIANGLE_STRIPS 1 5\n4 0 1 3 2\n", [[0, 1, 3], [3, 1, 2]]),
        (
            "5.1",
            "POLYGONS 3 7\nOFFSETS vtktypeint64\n0 4 7\nCONNECTIVITY vtktypeint64\n0 1 2 3 0 1 2\n",
            [[0, 1, 2], [0, 2, 3], [0, 1, 2]],
        ),
    ],
)
def test_vtk_polygons_and_strips(tmp_path: Path, version: str, cells: str, faces: list[list[int]]) -> None:
    more = "CELL_DATA 1\nSCALARS part int 1\nLOOKUP_TABLE default\n7\n"
    more += "POINT_DATA 4\nSCALARS a%20b double\nLOOKUP_TABLE default\n1 2 3 4\nVECTORS v float\n" + "1 2 3\n" * 4
    more += "COLOR_SCALARS c 3\n" + "1 0 0.5\n" * 4
    (tmp_path / "a.vtk").write_text(VTK.format(version) + cells + (more if version == "2.0" else ""))
    mesh = read_mesh(tmp_path / "a.vtk")
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    if version == "2.0":
        assert mesh.attributes["a b"].tolist() == [1, 2, 3, 4]
        np.testing.assert_array_equal(mesh.attributes["v"], [[1, 2, 3]] * 4)
        np.testing.assert_array_equal(mesh.attributes["colors"], [[255, 0, 128]] * 4)
        assert read_any(tmp_path / "a.vtk")[1] == ("values of polygons or of the whole",)


def test_vtp_polygons(tmp_path: Path) -> None:
    array = '<DataArray type="Float32" NumberOfComponents="3">0 0 0 1 0 0 1 1 0 0 1 0</DataArray>'
    polys = '<DataArray type="Int32" Name="connectivity">0 1 2 3 0 1 2</DataArray>'
    polys += '<DataArray type="Int32" Name="offsets">4 7</DataArray>'
    piece = f'<Piece NumberOfPoints="4"><Points>{array}</Points><Polys>{polys}</Polys></Piece>'
    path = tmp_path / "a.vtp"
    path.write_text(f'<VTKFile type="PolyData"><PolyData>{piece}{piece}</PolyData></VTKFile>')
    mesh = read_mesh(path)
    one = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    np.testing.assert_array_equal(mesh.faces, np.concatenate([one, one + 4]))


def test_vtu_and_vts(tmp_path: Path) -> None:
    array = '<DataArray type="Float32" NumberOfComponents="3">0 0 0 1 0 0 1 1 0 0 1 0</DataArray>'
    cells = "".join(
        f'<DataArray type="Int32" Name="{name}">{values}</DataArray>'
        for name, values in (("connectivity", "0 1 2 3 1 0 1 2 0 2 3"), ("offsets", "4 5 8 11"), ("types", "10 1 5 5"))
    )
    grid = f'<Piece NumberOfPoints="4"><Points>{array}</Points><Cells>{cells}</Cells></Piece>'
    (tmp_path / "a.vtu").write_text(f'<VTKFile type="UnstructuredGrid"><U>{grid}</U></VTKFile>')
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.vtu").faces, [[0, 1, 2], [0, 2, 3]])
    grid = f'<Piece Extent="0 1 0 1 0 0"><Points>{array}</Points></Piece>'
    (tmp_path / "a.vts").write_text(f'<VTKFile type="StructuredGrid"><S>{grid}</S></VTKFile>')
    assert len(read_cloud(tmp_path / "a.vts")) == 4


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("a.vtk", "# vtk DataFile Version 3.0\nt\nASCII\nDATASET IMAGE\n", "but POLYDATA, UNSTRUCTURED_GRID"),
        ("a.vtk", VTK.format("3.0").replace("POINTS 4", "POINTS 5"), "ends after 12 of 15 numbers"),
        ("a.vtk", VTK.format("3.0").replace("POINTS 4", "POINTS 99999999999"), "ends within"),
        ("a.vtk", VTK.format("3.0").replace("float", "quad"), "number type 'quad'"),
        ("a.vtk", VTK.format("3.0") + "POLYGONS 9999999999 4\n3 0 1 2\n", "size that their section declares"),
        ("a.vtk", VTK.format("3.0") + "POLYGONS 1 4\n7 0 1 2\n", "size that their section declares"),
        ("a.vtk", VTK.format("3.0") + "HELLO 1\n", "does not begin a known section"),
        ("a.vtp", "<VTKFile", "not a well-formed file of VTK"),
        ("a.vtp", '<VTKFile type="ImageData"></VTKFile>', "grid of VTK, but found 'ImageData'"),
        ("a.vtp", '<VTKFile type="PolyData" compressor="vtkLZ4DataCompressor"></VTKFile>', "vtkLZ4DataCompressor"),
        ("a.e57", "ASTM-E57" + "x" * 99, "E57"),
        ("a.gltf", "{", "glTF"),
        ("a.gltf", json.dumps({"buffers": [{"uri": "../a.bin", "byteLength": 3}]}), "outside of the file's folder"),
        ("a.gltf", json.dumps({"buffers": [{"uri": "a.bin", "byteLength": 3}]}), "missing from the file's folder"),
    ],
)
def test_damaged_data_sets(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, text: str, sentence: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=sentence) as caught:
        read_cloud(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_gltf_builds_no_more_than_the_file_can_hold(tmp_path: Path) -> None:
    path = file_of("gltf-embedded", random_cloud(np.random.default_rng(0), 20), tmp_path)
    whole = path.read_text()
    deep = [{"mesh": 0, "children": [place + 1]} for place in range(1_500)] + [{"mesh": 0}]
    zeros = {"componentType": 5126, "type": "VEC4", "count": len(whole)}
    damages: list[tuple[str, Callable[[Any], object]]] = [
        ("declares 1000000000 values", lambda tree: tree["accessors"][0].update(count=10**9)),
        ("declares 20 values", lambda tree: tree["bufferViews"][1].update(byteLength=19)),
        ("more than the file holds", lambda tree: tree["accessors"].extend([zeros] * 2)),
        ("sparse", lambda tree: tree["accessors"][0].update(sparse={"count": 1})),
        ("builds 20,000 objects", lambda tree: tree.update(nodes=[{"mesh": 0}] * 20_000)),
        ("nested too deep", lambda tree: tree.update(nodes=deep)),
    ]
    for sentence, damage in damages:
        tree = json.loads(whole)
        damage(tree)
        path.write_text(json.dumps(tree))
        with pytest.raises(InputError, match=sentence):
            read_cloud(path)


def test_compressed_files_are_recognised_whatever_they_are_called(tmp_path: Path) -> None:
    cloud = random_cloud(np.random.default_rng(0), 20)
    packed = file_of("xyz-gz", cloud, tmp_path)
    np.testing.assert_array_equal(read_cloud(packed.rename(tmp_path / "a.xyz")).points, cloud.points)
    (tmp_path / "b.xyz.gz").write_bytes(gzip.compress(b"0 0 0\n")[:-6])
    with pytest.raises(InputError, match=r"b.xyz.gz: the compressed data is damaged"):
        read_cloud(tmp_path / "b.xyz.gz")


class Piped(io.StringIO):
    """Standard input that is a pipe."""

    def __init__(self, data: bytes, terminal: bool = False) -> None:
        self.buffer, self._terminal = io.BytesIO(data), terminal

    def isatty(self) -> bool:
        return self._terminal


def test_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    for data in (b"0 0 0\n1 2 3\n", gzip.compress(b"0 0 0\n1 2 3\n")):
        monkeypatch.setattr(sys, "stdin", Piped(data))
        np.testing.assert_array_equal(read_cloud("-", "xyz").points, [[0, 0, 0], [1, 2, 3]])
    monkeypatch.setattr(sys, "stdin", Piped(b"0 0\n"))
    with pytest.raises(InputError, match=r"^standard input: expected at least 3 columns"):
        read_cloud("-", "xyz")
    with pytest.raises(UsageError, match="Standard input has no extension: say with --format"):
        read_cloud("-")
    monkeypatch.setattr(sys, "stdin", Piped(b"", terminal=True))
    with pytest.raises(UsageError, match="is a terminal"):
        read_cloud("-", "xyz")


def test_e57_without_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = file_of("e57", random_cloud(np.random.default_rng(0), 5), tmp_path)
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(InputError, match="pip install pye57"):
        read_cloud(path)
