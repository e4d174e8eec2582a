"""Any error in a file becomes an InputError of one sentence, without a crash or other output."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import READERS, WRITERS, read_cloud, read_mesh, write_mesh
from gnrecon.runtime.errors import GnreconError, InputError, UsageError

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256))
PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n{}end_header\n{}"
PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\n"
PCD += "HEIGHT 1\nPOINTS {0}\nDATA {1}\n"
FOUR = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
FACES = "element face 1\nproperty list uchar int vertex_indices\n"

MALFORMED: list[tuple[str, str | bytes, str]] = [
    ("a.ply", PLY.format("", "0 0 0\n1 0 0\n0 1"), "declares 4 vertex rows.*ends after 2"),
    ("a.ply", PLY.format(FACES, FOUR), "declares 1 face rows.*ends after 0"),
    ("a.ply", PLY.format(FACES, FOUR + "3 0 1\n"), "declares 1 face rows.*ends after 0"),
    ("a.ply", PLY.format(FACES, FOUR + "3 0 1 9\n"), "outside of 0 to 3"),
    ("a.ply", PLY.format(FACES, FOUR + "-3 0 1 2\n"), "length -3"),
    ("a.ply", PLY.format("", "0 0 0\n1 zero 0\n"), "'zero' is not a number"),
    ("a.ply", PLY.format("", FOUR).replace("float z", "float w"), "columns named x, y and z.*found x, y, w"),
    ("a.ply", PLY.format("", FOUR).replace("float z", "quad z"), "'property quad z' is not understood"),
    ("a.ply", PLY.format("", FOUR).replace("ascii", "morse"), "'format morse 1.0' is not understood"),
    ("a.ply", PLY.format("", FOUR).replace("format ascii 1.0\n", ""), "no format line"),
    ("a.ply", PLY.format("", FOUR).replace("end_header", ""), "does not end with 'end_header'"),
    ("a.ply", PLY.format("", FOUR).replace("vertex 4", "vertex 0"), "holds no points"),
    ("a.ply", PLY.format("", FOUR).replace("vertex 4", "corner 4"), "no vertex element"),
    ("a.ply", PLY.format("", "").replace("ascii", "binary_little_endian") + "abc", "ends after 0"),
    ("a.ply", PLY.format("", "").replace("ascii", "binary_little_endian").replace("4", "9" * 15), "ends after 0"),
    ("a.ply", "hello, this is some text\n", "not a PLY file"),
    ("a.pcd", PCD.format(4, "ascii") + "0 0 0\n1 1 1\n", "declares 4 points"),
    ("a.pcd", PCD.format(4, "binary").encode() + bytes(30), "declares 4 points"),
    ("a.pcd", PCD.format(4, "binary_compressed").encode() + bytes(30), "declares 4 points.*ends after 0"),
    ("a.pcd", PCD.format(10**13, "binary").encode() + bytes(30), "ends after 2"),
    ("a.pcd", PCD.format(4, "ascii") + FOUR.replace("1", "one"), "'one' is not a number"),
    ("a.pcd", PCD.format(4, "morse") + FOUR, "encoding 'morse' is unknown"),
    ("a.pcd", PCD.format("many", "ascii") + FOUR, "'many'"),
    ("a.pcd", PCD.format(4, "ascii").replace("x y z", "x y i") + FOUR, "fields named x, y and z"),
    ("a.pcd", "hello, this is some text\n", "header lacks FIELDS"),
    ("a.xyz", "0 0 0\n1 1\n", "row 2 holds 2 numbers, but the rows before it hold 3"),
    ("a.xyz", "0 0 0\n1 one 1\n", "'one' in row 2 is not a number"),
    ("a.xyz", "0 0\n1 1\n", "at least 3 columns"),
    ("a.xyz", "x y z\n0 0\n", "at least 3 columns \\(x, y, z\\), but found 2"),
    ("a.xyz", "# nothing here\n", "no points"),
    ("a.xyz", "x y z\n", "no points"),
    ("a.txt", "Dear reader,\nthis is a letter.\n", "neither numbers nor columns"),
    ("a.pts", "5\n0 0 0\n1 1 1\n", "declares 5 points, but 2 follow"),
    ("a.pts", "5\n", "no points"),
    ("a.csv", "x,y,z,nx\n0,0,0\n", "names 4 columns, but the rows hold 3"),
    ("a.csv", "a,b,c\n0,0,0\n", "columns named x, y and z"),
    ("a.obj", "v 0 0\n", "at least 3"),
    ("a.obj", "v 0 0 zero\n", "'zero' is not a number"),
    ("a.obj", "f 1 2 3\n", "no vertex line"),
    ("a.obj", "v 0 0 0\nf 1 2 3\n", "names vertex 3, but there are 1"),
    ("a.obj", "v 0 0 0\nf 0 0 0\n", "indices begin at 1"),
    ("a.obj", "v 0 0 0\nf a b c\n", "not a vertex index"),
    ("a.obj", "v 0 0 0\nvn 0 0 1\nf 1//2 1//2 1//2\n", "names normal 2, but there are 1"),
    ("a.obj", "hello, this is some text\n", "no vertex line"),
    ("a.off", "OFF\n4 1 0\n0 0 0\n", "declares 4 vertices and 1 faces, but 1 rows"),
    ("a.off", "OFF\n1 1 0\n0 0 0\n3 0 0\n", "not a count and as many"),
    ("a.off", "OFF\n1 1 0\n0 0 0\n3 0 0 5\n", "outside of 0 to 0"),
    ("a.off", "OFF\nmany\n", "numbers of vertices and faces"),
    ("a.off", "OFF\n0 0 0\n", "no vertices"),
    ("a.off", "NOFF\n1 0 0\n0 0 0\n", "need 6 numbers"),
    ("a.off", "hello, this is some text\n", "begins with the word OFF"),
    ("a.stl", b"\0" * 80 + b"\x05\0\0\0" + bytes(50), "STL"),
    ("a.stl", "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "STL"),
    ("a.stl", "solid a\nvertex 0 0 0\nvertex 1 0 zero\nvertex 0 1 0\nendsolid\n", "STL"),
    ("a.stl", "hello, this is some text\n", "STL"),
    ("a.glb", b"glTF\x02\0\0\0" + bytes(100), "GLB"),
    ("a.glb", "hello, this is some text\n", "GLB"),
    ("a.las", "LASF", "header of a LAS file"),
    ("a.docx", FOUR, "extension '.docx' is not supported; expected one of ply, pcd, xyz"),
    ("scan", FOUR, "extension '' is not supported"),
]


@pytest.mark.parametrize(("name", "content", "sentence"), MALFORMED)
def test_malformed_files_are_named_in_one_sentence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, content: str | bytes, sentence: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError, match=sentence) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", sorted(READERS))
def test_no_reader_accepts_nothing_images_or_folders(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.raises(InputError, match="no such file"):
        read_cloud(path)
    for content, sentence in [(b"", "is empty"), (b"\n \n", "is empty"), (PNG, "PNG image")]:
        path.write_bytes(content)
        with pytest.raises(InputError, match=sentence):
            read_cloud(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match="folder"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", sorted(set(READERS) - {".ply"}))
def test_a_ply_of_another_name_is_recognised(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_text(PLY.format("", FOUR))
    with pytest.raises(InputError, match="holds PLY data; rename it or give its format as 'ply'"):
        read_cloud(path)
    assert len(read_cloud(path, "ply")) == 4


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may read every file")
def test_unreadable_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(PLY.format("", FOUR))
    path.chmod(0)
    with pytest.raises(InputError, match="cannot be read"):
        read_cloud(path)


def test_unknown_format_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="'docx' is not supported"):
        read_cloud(tmp_path / "a.ply", "docx")


def test_a_cloud_is_no_mesh(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text(FOUR)
    with pytest.raises(InputError, match="holds 4 points and no faces"):
        read_mesh(tmp_path / "a.xyz")


def _valid_files() -> dict[str, bytes]:
    mesh = Mesh(np.random.default_rng(0).normal(size=(6, 3)), [[0, 1, 2], [3, 4, 5]])
    files = {".xyz": FOUR.encode(), ".pcd": (PCD.format(4, "ascii") + FOUR).encode()}
    with tempfile.TemporaryDirectory() as folder:
        for suffix in WRITERS:
            write_mesh(mesh, Path(folder) / f"a{suffix}")
            files[suffix] = (Path(folder) / f"a{suffix}").read_bytes()
    return files


VALID = _valid_files()


@pytest.mark.parametrize("suffix", sorted(VALID))
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_files_never_raise_anything_else(suffix: str, data: st.DataObject) -> None:
    content = bytearray(VALID[suffix])
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    del content[data.draw(st.integers(1, len(content))) :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        path.write_bytes(bytes(content))
        try:
            cloud = read_cloud(path)
        except GnreconError:
            return
        assert len(cloud) > 0
