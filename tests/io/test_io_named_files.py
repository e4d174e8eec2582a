"""Files that a scan's file names, which no run may write."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from gnrecon.io.named_files import all_input_files

GLTF = {"buffers": [{"uri": "../a b.bin"}, {}, {"uri": "a%20b.bin"}], "images": [{"bufferView": 0}, {"uri": "t.png"}]}


@pytest.mark.parametrize(
    ("name", "text", "named"),
    [
        ("u.conf", "bmesh a.ply 0 0 0 0 0 0 1\nbmesh missing.ply 0 0 0 0 0 0 1\n", ["a.ply"]),
        ("u.gltf", json.dumps(GLTF), ["a b.bin", "t.png"]),
        ("u.obj", "# c\nmtllib a b.mtl\nv 0 0 0\n", ["a b.mtl", "t.png"]),
        ("u.OBJ", "MTLLIB no.mtl m.mtl\r\nv 0 0 0\r\n", ["m.mtl", "t.png", "s.png"]),
        ("u.ply", "ply\nformat ascii 1.0\ncomment TextureFile t.png\nend_header\n", ["t.png"]),
        ("u.xyz", "comment TextureFile t.png\n", []),
        ("u.gltf", "[" * 100_000, []),
        ("u.gltf", '{"buffers": 3}', []),
        ("u.obj", "mtllib \0\nmtllib m.mtl\n", ["m.mtl", "t.png", "s.png"]),
    ],
)
def test_files_are_found_by_their_names(tmp_path: Path, name: str, text: str, named: list[str]) -> None:
    for other in ("a.ply", "a b.bin", "t.png", "s.png"):
        (tmp_path / other).touch()
    (tmp_path / "a b.mtl").write_text("newmtl a\n map_Kd -s 1 1 1 t.png\n")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t.png\nbump s.png\n")
    (tmp_path / name).write_text(text)
    assert all_input_files([tmp_path / name]) == [tmp_path / name, *(tmp_path / one for one in named)]
    copy = tmp_path / "copy"
    (tmp_path / name).rename(copy)
    assert all_input_files([copy], name.rpartition(".")[2]) == [copy, *(tmp_path / one for one in named)]


def test_a_pipe_is_left_to_its_reader(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "u.obj")
    assert all_input_files([tmp_path / "u.obj"]) == [tmp_path / "u.obj"]
