"""Colours and other attributes of vertices: written where a format can hold them, and read back, also by others."""

from __future__ import annotations

import json
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import as_cloud, read_cloud, read_mesh, supports_attribute, to_open3d, to_trimesh, write_mesh
from gnrecon.runtime.errors import InputError

COLOURED = [".ply", ".obj", ".off", ".glb", ".3mf"]
UTM = np.array([431234.123456789, 5412345.987654321, 312.1])


@pytest.fixture
def mesh(rng: np.random.Generator) -> Mesh:
    """An octahedron, finely divided, in all colours."""
    corners = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(3):
        ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, which = np.unique(ends, axis=0, return_inverse=True)
        middle = len(corners) + which.reshape(-1, 3)
        corners = np.concatenate([corners, corners[edges].mean(axis=1)])
        a, b, c, ab, bc, ca = *faces.T, *middle.T
        faces = np.concatenate(
            [np.stack(three, axis=1) for three in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    count = len(corners)
    return Mesh(corners, faces, None, {"colors": rng.integers(0, 256, (count, 3)).astype(np.uint8)})


def test_the_shape_is_what_it_should_be(mesh: Mesh) -> None:
    assert mesh.euler_characteristic == 2
    assert mesh.volume == pytest.approx(4 / 3)


@pytest.mark.parametrize("suffix", COLOURED)
@pytest.mark.parametrize("alpha", [False, True], ids=["opaque", "alpha"])
def test_colours_come_back_exactly(suffix: str, alpha: bool, mesh: Mesh, tmp_path: Path) -> None:
    colors = mesh.attributes["colors"]
    if alpha:
        mesh = mesh.with_attributes({"colors": np.hstack([colors, colors[:, :1]])})
    assert write_mesh(mesh, tmp_path / f"m{suffix}") == []
    again = read_mesh(tmp_path / f"m{suffix}")
    assert np.array_equal(again.faces, mesh.faces)
    assert again.attributes["colors"].dtype == np.uint8
    if suffix == ".obj":  # which has no place for alpha
        assert np.array_equal(again.attributes["colors"], colors)
    elif suffix == ".off" and not alpha:  # which always has one
        assert np.array_equal(again.attributes["colors"][:, :3], colors)
    else:
        assert np.array_equal(again.attributes["colors"], mesh.attributes["colors"])
    assert "colors" in read_cloud(tmp_path / f"m{suffix}").attributes


def test_ply_holds_attributes_of_all_kinds_in_their_types(mesh: Mesh, tmp_path: Path, rng: np.random.Generator) -> None:
    count = len(mesh.vertices)
    given = {
        "heat": rng.normal(size=count),
        "sigma": rng.normal(size=count).astype(np.float32),
        "label": rng.integers(-5, 5, count).astype(np.int16),
        "big": rng.integers(0, 2**32, count),
        "id": rng.integers(-(2**31), 2**31, count),
        "huge": rng.integers(0, 2**52, count),
        "flag": rng.integers(0, 2, count).astype(bool),
        "x": np.ones(count),
        "two words é": np.arange(count, dtype=np.uint8),
        "flow": rng.normal(size=(count, 2)),
    }
    assert write_mesh(mesh.with_attributes(given), tmp_path / "m.ply") == []
    found = read_mesh(tmp_path / "m.ply")
    assert np.array_equal(found.vertices, mesh.vertices)
    assert np.array_equal(found.attributes["colors"], mesh.attributes["colors"])
    names = ["heat", "sigma", "label", "big", "id", "huge", "flag", "x_", "two_words__", "flow_0", "flow_1"]
    assert sorted(found.attributes) == sorted([*names, "colors"])
    for name, values in zip(names, [*list(given.values())[:-1], *given["flow"].T], strict=True):
        assert np.array_equal(found.attributes[name], values), name
    kinds = [found.attributes[name].dtype.str[1:] for name in names]
    assert kinds == ["f8", "f4", "i2", "u4", "i4", "f8", "u1", "f8", "u1", "f8", "f8"]


def test_glb_holds_finite_numbers(mesh: Mesh, tmp_path: Path, rng: np.random.Generator) -> None:
    count = len(mesh.vertices)
    heat, flow, label = rng.normal(size=count), rng.normal(size=(count, 3)), rng.integers(0, 9, count)
    hole = np.where(np.arange(count) == 3, np.nan, heat)
    exact = np.full(count, 2**24 + 1)
    given = mesh.with_attributes({"Heat": heat, "flow": flow, "label": label, "hole": hole, "exact": exact})
    assert write_mesh(given, tmp_path / "m.glb") == ["GLB cannot hold hole and exact of the vertices; PLY can."]
    found = read_mesh(tmp_path / "m.glb").attributes
    assert sorted(found) == ["colors", "flow", "heat", "label"]
    assert np.array_equal(found["heat"], heat.astype(np.float32))
    assert np.array_equal(found["flow"], flow.astype(np.float32))
    assert np.array_equal(found["label"], label)


@pytest.mark.parametrize(
    ("suffix", "sentence"),
    [
        (".stl", "STL cannot hold colors, heat and label of the vertices; PLY can."),
        (".off", "OFF cannot hold heat and label of the vertices; PLY can."),
        (".obj", "OBJ cannot hold heat and label of the vertices; PLY can."),
        (".3mf", "3MF cannot hold heat and label of the vertices; PLY can."),
    ],
)
def test_losses_are_reported(suffix: str, sentence: str, mesh: Mesh, tmp_path: Path) -> None:
    count = np.arange(len(mesh.vertices))
    full = mesh.with_attributes({"heat": count / 2, "label": count})
    assert write_mesh(full, tmp_path / f"m{suffix}") == [sentence]
    assert not supports_attribute(tmp_path / f"m{suffix}", "heat", count)
    assert not set(read_mesh(tmp_path / f"m{suffix}").attributes) - {"colors"}


def test_a_number_beyond_single_precision_is_a_loss_without_a_warning(mesh: Mesh, tmp_path: Path) -> None:
    hot = mesh.with_attributes({"heat": np.full(len(mesh.vertices), 1e200)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert write_mesh(hot, tmp_path / "m.glb") == ["GLB cannot hold heat of the vertices; PLY can."]


@pytest.mark.parametrize("suffix", [*COLOURED, ".stl"])
def test_the_same_mesh_gives_the_same_bytes(suffix: str, mesh: Mesh, tmp_path: Path) -> None:
    full = mesh.with_attributes({"heat": np.arange(len(mesh.vertices)) / 7})
    for name in "ab":
        write_mesh(full, tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", [".ply", ".off", ".obj"])
def test_others_read_our_colours(suffix: str, mesh: Mesh, tmp_path: Path) -> None:
    import open3d

    write_mesh(mesh, tmp_path / f"m{suffix}")
    seen = open3d.io.read_triangle_mesh(str(tmp_path / f"m{suffix}"))
    # Its reader of OBJ gives vertices an order of its own.
    which = np.linalg.norm(np.asarray(seen.vertices)[:, None] - mesh.vertices, axis=2).argmin(axis=1)
    assert np.array_equal(np.rint(255 * np.asarray(seen.vertex_colors)), mesh.attributes["colors"][which])


def test_others_read_our_glb_as_linear_light_on_a_matt_surface(mesh: Mesh, tmp_path: Path) -> None:
    import trimesh

    gray = np.full((len(mesh.vertices), 3), 188, np.uint8)
    write_mesh(mesh.with_attributes({"colors": gray}), tmp_path / "m.glb")
    data = (tmp_path / "m.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    primitive = tree["meshes"][0]["primitives"][0]
    accessor = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    assert tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0
    # 188 is half the light.
    view = tree["bufferViews"][accessor["bufferView"]]
    start = 28 + int.from_bytes(data[12:16], "little") + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stored = np.frombuffer(data[start : start + view["byteLength"]], "<u2").reshape(-1, 4)
    assert np.abs(stored[:, :3] / 65535 - 0.5029).max() < 1e-4
    assert (stored[:, 3] == 65535).all()
    assert trimesh.load_scene(tmp_path / "m.glb", process=False).to_mesh().is_watertight


def test_colours_of_others_are_read(tmp_path: Path, mesh: Mesh) -> None:
    import trimesh

    theirs = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    theirs.visual.vertex_colors = mesh.attributes["colors"]
    theirs.export(tmp_path / "m.ply")
    assert np.array_equal(read_mesh(tmp_path / "m.ply").attributes["colors"][:, :3], mesh.attributes["colors"])
    theirs.export(tmp_path / "m.glb")
    found = read_mesh(tmp_path / "m.glb").attributes["colors"]
    assert found.shape == (len(mesh.vertices), 3)


def test_objects_of_other_libraries_carry_colours(mesh: Mesh) -> None:
    full = mesh.with_attributes({"heat": np.arange(len(mesh.vertices)) / 7})
    colors = mesh.attributes["colors"]
    theirs = to_trimesh(full)
    assert np.array_equal(theirs.visual.vertex_colors[:, :3], colors)
    assert np.array_equal(theirs.vertex_attributes["heat"], full.attributes["heat"])
    assert np.array_equal(as_cloud(theirs).attributes["colors"][:, :3], colors)
    assert np.array_equal(np.rint(255 * np.asarray(to_open3d(full).vertex_colors)), colors)
    assert np.array_equal(as_cloud(full).attributes["heat"], full.attributes["heat"])
    plain = to_trimesh(Mesh(mesh.vertices, mesh.faces))
    assert as_cloud(plain).attributes == {}


def test_an_independent_library_reads_our_3mf(mesh: Mesh, tmp_path: Path) -> None:
    lib3mf = pytest.importorskip("lib3mf", reason="lib3mf has wheels for a few machines only")
    for name, offset, part in (
        ("near", np.zeros(3), mesh.faces),
        ("far", UTM, mesh.faces),
        ("open", np.zeros(3), mesh.faces[3:]),
    ):
        moved = Mesh(mesh.vertices + offset, part, None, mesh.attributes)
        write_mesh(moved, tmp_path / f"{name}.3mf")
        model = lib3mf.get_wrapper().CreateModel()
        reader = model.QueryReader("3mf")
        reader.SetStrictModeActive(True)
        reader.ReadFromFile(str(tmp_path / f"{name}.3mf"))
        assert reader.GetWarningCount() == 0
        assert model.GetUnit() == lib3mf.ModelUnit.MilliMeter
        items, objects = model.GetBuildItems(), model.GetMeshObjects()
        assert items.MoveNext()
        assert objects.MoveNext()
        found = objects.GetCurrentMeshObject()
        assert found.IsManifoldAndOriented() == (name != "open")
        assert found.GetType() == (lib3mf.ObjectType.Surface if name == "open" else lib3mf.ObjectType.Model)
        way = np.array([list(column) for column in items.GetCurrent().GetObjectTransform().Fields])
        assert np.abs(way[3] - (offset if name == "far" else 0)).max() < 0.5
        vertices = np.array([list(vertex.Coordinates) for vertex in found.GetVertices()])
        assert np.abs(vertices - mesh.vertices).max() < 1e-6
        faces = np.array([list(triangle.Indices) for triangle in found.GetTriangleIndices()])
        assert np.array_equal(faces, part)
        groups = model.GetColorGroups()
        assert groups.MoveNext()
        group = groups.GetCurrentColorGroup()
        for number in range(0, len(faces), 17):
            ids = found.GetTriangleProperties(number).PropertyIDs
            seen = [group.GetColor(id_) for id_ in ids]
            assert [[c.Red, c.Green, c.Blue] for c in seen] == mesh.attributes["colors"][faces[number]].tolist()


@pytest.mark.parametrize("offset", [np.zeros(3), UTM], ids=["near", "far"])
def test_3mf_keeps_all_digits(offset: np.ndarray, tmp_path: Path, rng: np.random.Generator) -> None:
    mesh = Mesh(rng.normal(size=(30, 3)) + offset, rng.integers(0, 30, (40, 3)))
    write_mesh(mesh, tmp_path / "m.3mf")
    found = read_mesh(tmp_path / "m.3mf")
    if offset.any():
        np.testing.assert_allclose(found.vertices, mesh.vertices, rtol=0, atol=2 * np.spacing(offset.max()))
    else:
        assert np.array_equal(found.vertices, mesh.vertices)
    assert np.array_equal(found.faces, mesh.faces)
    assert found.attributes == {}


PARTS = """<?xml version="1.0" encoding="UTF-8"?>
<model unit="inch" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
 xmlns:m="http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
 xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06"><resources>
<basematerials id="5">
<base name="red" displaycolor="#FF0000"/><base name="glass" displaycolor="#00FF0080"/></basematerials>
<object id="1" pid="5" pindex="1"><mesh>
<vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>
<vertex x="0" y="1" z="0"/><vertex x="0" y="0" z="1"/></vertices>
<triangles><triangle v1="0" v2="2" v3="1" pid="5" p1="0"/><triangle v1="0" v2="1" v3="3"/></triangles></mesh></object>
<object id="2"><components>{components}</components></object></resources>
<build><item objectid="{item}" transform="2 0 0 0 2 0 0 0 2 10 20 30"/></build></model>"""
TWICE = (
    '<component objectid="1"/><component objectid="1" transform="-1 0 0 0 1 0 0 0 1 0 0 5"/>'
    '<component objectid="7" p:path="/3D/other.model"/>'
)
OTHER = """<model xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>
<object id="7"><mesh><vertices>
<vertex x="7" y="7" z="7"/><vertex x="8" y="7" z="7"/><vertex x="7" y="8" z="7"/></vertices><triangles>
<triangle v1="0" v2="1" v3="2"/></triangles></mesh></object></resources><build><item objectid="99"/></build></model>"""


def archive(path: Path, model: str, relations: bool = True) -> Path:
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    with zipfile.ZipFile(path, "w") as file:
        if relations:
            file.writestr("_rels/.rels", f'<R xmlns="a"><Relationship Target="/3D/main.model" Type="{kind}"/></R>')
        file.writestr("3D/main.model", model)
        file.writestr("3D/other.model", OTHER)
    return path


def test_3mf_objects_are_put_together_as_the_model_says(tmp_path: Path) -> None:
    mesh = read_mesh(archive(tmp_path / "m.3mf", PARTS.format(components=TWICE, item=2)))
    assert mesh.vertices.tolist()[:4] == [[10, 20, 30], [12, 20, 30], [10, 22, 30], [10, 20, 32]]
    assert mesh.vertices.tolist()[4:6] == [[10, 20, 40], [8, 20, 40]]
    assert mesh.vertices.tolist()[8:] == [[24, 34, 44], [26, 34, 44], [24, 36, 44]]
    # The second one is a mirror image, so its faces are turned round.
    assert mesh.faces.tolist() == [[0, 2, 1], [0, 1, 3], [5, 6, 4], [7, 5, 4], [8, 9, 10]]
    red, glass, none = [255, 0, 0, 255], [0, 255, 0, 128], [0, 0, 0, 0]
    assert mesh.attributes["colors"].tolist() == [red, red, red, glass, red, red, red, glass, none, none, none]


@pytest.mark.parametrize(
    ("components", "item", "sentence"),
    [
        ('<component objectid="2"/>', 2, "contains itself"),
        ("", 4, "'4', which does not exist"),
        ("", 2, "builds no mesh"),
        ('<component objectid="1" transform="1 2"/>', 2, "malformed"),
    ],
)
def test_damaged_3mf_models_are_refused(components: str, item: int, sentence: str, tmp_path: Path) -> None:
    path = archive(tmp_path / "m.3mf", PARTS.format(components=components, item=item))
    with pytest.raises(InputError, match=sentence):
        read_mesh(path)


@pytest.mark.parametrize(
    ("levels", "copies", "items", "sentence"),
    [
        (6, 20, 1, "the scene builds 67,368,421 objects"),
        (40, 1, 1, "contains itself"),
        (40, 1, 40, "more than 32 levels"),
    ],
)
def test_3mf_models_that_multiply_are_refused(
    levels: int, copies: int, items: int, sentence: str, tmp_path: Path
) -> None:
    """`items` objects are built, the innermost first, so that each knows the one within."""
    corner = '<object id="0"><mesh><vertices><vertex x="0" y="0" z="0"/></vertices><triangles/></mesh></object>'
    rows = [
        f'<object id="{level}">' + copies * f'<component objectid="{level - 1}"/>' + "</object>"
        for level in range(1, levels + 1)
    ]
    built = "".join(f'<item objectid="{levels - place}"/>' for place in reversed(range(items)))
    model = f"<model><resources>{corner}{''.join(rows)}</resources><build>{built}</build></model>"
    with pytest.raises(InputError, match=sentence):
        read_mesh(archive(tmp_path / "m.3mf", model))


def test_damaged_3mf_archives_are_refused(tmp_path: Path, mesh: Mesh) -> None:
    whole = tmp_path / "whole.3mf"
    write_mesh(mesh, whole)
    (tmp_path / "cut.3mf").write_bytes(whole.read_bytes()[:-500])
    (tmp_path / "text.3mf").write_text("solid")
    archive(tmp_path / "unrelated.3mf", PARTS, relations=False)
    archive(tmp_path / "torn.3mf", PARTS[:300])
    for name in ("cut", "text", "unrelated", "torn"):
        with pytest.raises(InputError, match="not a well-formed 3MF archive") as caught:
            read_mesh(tmp_path / f"{name}.3mf")
        assert "\n" not in str(caught.value)
    (tmp_path / "zipped.ply").write_bytes(whole.read_bytes())
    with pytest.raises(InputError, match="ZIP archive"):
        read_mesh(tmp_path / "zipped.ply")
