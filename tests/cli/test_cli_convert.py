"""`gnrecon convert` changes the format and nothing else, and names what the format cannot hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import CommandLine, ball, cube

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import read_any, read_cloud, read_mesh, write_cloud, write_mesh
from gnrecon.runtime.errors import ExitCode

UTM = np.array([500_000.125, 4_500_000.25, 100.0])


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def rich_mesh(rng: np.random.Generator) -> Mesh:
    """A sphere in projected coordinates with normals, colours and a measured value."""
    mesh = ball()
    attributes = {
        "colors": rng.integers(0, 256, (len(mesh.vertices), 3)).astype(np.uint8),
        "intensity": rng.normal(size=len(mesh.vertices)),
    }
    return Mesh(UTM + mesh.vertices, mesh.faces, mesh.vertices, attributes)


@pytest.fixture
def rich_cloud(rng: np.random.Generator) -> PointCloud:
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    attributes = {
        "colors": rng.integers(0, 256, (50, 4)).astype(np.uint8),
        "label": rng.integers(-5, 5, 50).astype(np.int32),
        "time": 1e9 + rng.random(50),
    }
    return PointCloud(UTM + rng.normal(size=(50, 3)), normals.astype(np.float32), attributes)


def test_a_mesh_to_ply_and_back_loses_nothing(tmp_path: Path, command: CommandLine, rich_mesh: Mesh) -> None:
    write_mesh(rich_mesh, tmp_path / "a.ply")
    done = command("convert", tmp_path / "a.ply", tmp_path / "b.ply")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == f"{tmp_path / 'b.ply'}: 642 vertices, 1280 faces.\n"
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize(
    ("suffix", "lost"),
    [
        ("obj", ["no place for intensity"]),
        ("off", ["no place for intensity", "Normals are not kept"]),
        (
            "stl",
            [
                "relative to the origin 500000 4500000 100. The file",
                "Coordinates are rounded",
                "no place for intensity, colors",
                "Normals are not kept",
            ],
        ),
        ("glb", ["Coordinates are rounded", "Values of intensity are rounded"]),
        ("3mf", ["no place for intensity", "Normals are not kept"]),
        ("csv", ["The 1280 faces are not kept"]),
    ],
)
def test_what_a_format_cannot_hold_is_named(
    tmp_path: Path, command: CommandLine, rich_mesh: Mesh, suffix: str, lost: list[str]
) -> None:
    write_mesh(rich_mesh, tmp_path / "a.ply")
    done = command("convert", tmp_path / "a.ply", tmp_path / f"b.{suffix}")
    assert done.returncode == 0, done.stderr
    *said, summary = done.stderr.splitlines()
    assert summary.startswith(f"{tmp_path / f'b.{suffix}'}: 642")
    for words in lost:
        assert any(words in sentence for sentence in said), (words, said)
    assert len(said) == len(lost), said


def test_quiet_says_nothing(tmp_path: Path, command: CommandLine, rich_mesh: Mesh) -> None:
    write_mesh(rich_mesh, tmp_path / "a.ply")
    done = command("convert", tmp_path / "a.ply", tmp_path / "b.off", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("suffix", ["ply", "xyz", "txt", "csv"])
def test_a_cloud_keeps_every_digit_of_every_column(
    tmp_path: Path, command: CommandLine, rich_cloud: PointCloud, suffix: str
) -> None:
    write_cloud(rich_cloud, tmp_path / "a.csv")
    done = command("convert", tmp_path / "a.csv", tmp_path / f"b.{suffix}")
    assert done.returncode == 0
    assert done.stderr == f"{tmp_path / f'b.{suffix}'}: 50 points.\n"
    back, unread = read_any(tmp_path / f"b.{suffix}")
    assert isinstance(back, PointCloud)
    assert unread == ()
    assert np.array_equal(back.points, rich_cloud.points)
    assert np.array_equal(back.normals, rich_cloud.normals)
    assert set(back.attributes) == set(rich_cloud.attributes)
    for name, values in rich_cloud.attributes.items():
        assert np.array_equal(back.attributes[name], values), name


def test_rows_without_a_value_stay_as_they_are(tmp_path: Path, command: CommandLine) -> None:
    (tmp_path / "a.xyz").write_text("0 0 0\nnan 1 2\n3 4 inf\n")
    assert command("convert", tmp_path / "a.xyz", tmp_path / "b.ply").returncode == 0
    expected = [[0, 0, 0], [np.nan, 1, 2], [3, 4, np.inf]]
    assert np.array_equal(read_cloud(tmp_path / "b.ply").points, expected, equal_nan=True)


def test_a_mesh_is_never_repaired(tmp_path: Path, command: CommandLine) -> None:
    whole = cube()
    torn = Mesh(np.vstack([whole.vertices, [[5, 5, 5]]]), np.vstack([whole.faces[1:], [[0, 0, 1]]]))
    write_mesh(torn, tmp_path / "torn.off")
    done = command("convert", tmp_path / "torn.off", tmp_path / "torn.ply")
    assert done.returncode == 0
    back = read_mesh(tmp_path / "torn.ply")
    assert np.array_equal(back.faces, torn.faces)
    assert np.array_equal(back.vertices, torn.vertices)


def test_joined_vertices_are_told(tmp_path: Path, command: CommandLine) -> None:
    whole = cube()
    loose = Mesh(whole.corners.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    write_mesh(loose, tmp_path / "loose.ply")
    done = command("convert", tmp_path / "loose.ply", tmp_path / "loose.stl")
    assert "36 vertices became 8" in done.stderr


def test_what_the_reader_leaves_out_is_named(tmp_path: Path, command: CommandLine) -> None:
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\no cube\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nusemtl red\nf 1/1 2/1 3/1 4/1\nl 1 2\n"
    )
    done = command("convert", tmp_path / "a.obj", tmp_path / "b.ply")
    said = done.stderr.splitlines()[0]
    assert "holds what is not read: " in said
    for words in ("texture coordinates", "materials", "lines", "names of objects", "1 polygons of more than three"):
        assert words in said
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n")
    assert "colours of faces" in command("convert", tmp_path / "a.off", tmp_path / "c.ply").stderr
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nproperty uchar flags\n"
        "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n3 0 1 2 7\n0 1\n"
    )
    said = command("convert", tmp_path / "a.ply", tmp_path / "d.off").stderr.splitlines()[0]
    assert said.endswith("holds what is not read: the element edge, flags of each face.")


def test_textures_of_a_glb_are_named(tmp_path: Path, command: CommandLine) -> None:
    import trimesh

    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)))
    (tmp_path / "a.glb").write_bytes(trimesh.Scene(box).export(file_type="glb"))
    done = command("convert", tmp_path / "a.glb", tmp_path / "b.ply")
    assert done.returncode == 0, done.stderr
    assert "texture coordinates" in done.stderr
    write_mesh(cube(), tmp_path / "plain.glb")
    assert "not read" not in command("convert", tmp_path / "plain.glb", tmp_path / "c.ply").stderr


def test_refusals(tmp_path: Path, command: CommandLine) -> None:
    write_mesh(ball(), tmp_path / "a.ply")
    (tmp_path / "cloud.xyz").write_text("0 0 0\n1 1 1\n")
    (tmp_path / "taken.obj").write_text("somebody's work")
    (tmp_path / "torn.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-3])
    before = names(tmp_path)
    a, new = tmp_path / "a.ply", tmp_path / "new.obj"
    command.refuses(ExitCode.INPUT, "There is no file", "convert", tmp_path / "missing.ply", new)
    command.refuses(ExitCode.INPUT, "face rows", "convert", tmp_path / "torn.ply", new)
    command.refuses(ExitCode.INPUT, "expected a file", "convert", tmp_path, new)
    command.refuses(
        ExitCode.USAGE, "use obj, ply, stl, off, glb, 3mf, xyz, txt, csv", "convert", a, tmp_path / "a.docx"
    )
    command.refuses(ExitCode.USAGE, "one without an extension", "convert", a, tmp_path / "a")
    command.refuses(ExitCode.USAGE, "Points cannot be written as '.obj'", "convert", tmp_path / "cloud.xyz", new)
    command.refuses(ExitCode.OUTPUT, "exists already", "convert", a, tmp_path / "taken.obj")
    command.refuses(ExitCode.OUTPUT, "does not exist", "convert", a, tmp_path / "no" / "new.obj")
    command.refuses(ExitCode.USAGE, "named twice", "convert", a, a, "--overwrite")
    (tmp_path / "link.ply").symlink_to(a)
    command.refuses(ExitCode.USAGE, "named twice", "convert", a, tmp_path / "link.ply", "--overwrite")
    (tmp_path / "link.ply").unlink()
    (tmp_path / "nan.off").write_text("OFF\n3 1 0\nnan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    command.refuses(ExitCode.MESH, "not finite", "convert", tmp_path / "nan.off", new)
    assert names(tmp_path) == sorted([*before, "nan.off"])
    assert (tmp_path / "taken.obj").read_text() == "somebody's work"
    assert command("convert", a, tmp_path / "taken.obj", "--overwrite").returncode == 0
    assert len(read_mesh(tmp_path / "taken.obj").faces) == 1280


def test_a_file_that_comes_back_otherwise_is_not_kept(
    tmp_path: Path, command: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gnrecon.io.format_registry import WRITERS

    write = WRITERS[".obj"]
    monkeypatch.setitem(WRITERS, ".obj", lambda mesh, path: write(Mesh(mesh.vertices, mesh.faces[1:]), path))
    write_mesh(ball(), tmp_path / "a.ply")
    sentence = "1279 of 1280 faces could be read back"
    command.refuses(ExitCode.OUTPUT, sentence, "convert", tmp_path / "a.ply", tmp_path / "b.obj")
    assert names(tmp_path) == ["a.ply"]
