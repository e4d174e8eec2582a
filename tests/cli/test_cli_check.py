"""`gnrecon check` says what a mesh is, and its exit code whether it bounds a solid."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import CommandLine, ball, cube

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh
from gnrecon.runtime.errors import ExitCode


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


def values(text: str) -> dict[str, str]:
    """What the text says of each name."""
    return dict(line.split()[:2] for line in text.splitlines())


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off", "glb"])
def test_a_sound_mesh(tmp_path: Path, command: CommandLine, suffix: str) -> None:
    write_mesh(cube(), tmp_path / f"cube.{suffix}")
    done = command("check", tmp_path / f"cube.{suffix}")
    assert (done.returncode, done.stderr) == (0, "")
    found = values(done.stdout)
    assert found["sound"] == found["closed"] == found["manifold"] == found["oriented"] == "yes"
    assert (found["vertices"], found["faces"], found["components"], found["genus"]) == ("8", "12", "1", "0")
    assert (found["area"], found["volume"]) == ("24", "8")
    assert found["self_intersecting_faces"] == found["repeated_faces"] == found["unused_vertices"] == "0"


def test_json_says_the_same_as_text(tmp_path: Path, command: CommandLine) -> None:
    write_mesh(ball(), tmp_path / "ball.ply")
    done = command("check", tmp_path / "ball.ply", "--json")
    assert done.returncode == 0
    found = json.loads(done.stdout)
    assert found["file"] == str(tmp_path / "ball.ply")
    assert (found["sound"], found["failures"], found["genus"], found["faces"]) == (True, [], 0, 1280)
    assert set(values(command("check", tmp_path / "ball.ply").stdout)) == set(found) - {"file", "failures"}


def test_all_that_is_wrong_is_named_and_the_exit_code_is_5(tmp_path: Path, command: CommandLine) -> None:
    whole = cube()
    faces = whole.faces.copy()
    faces[3] = faces[3, ::-1]
    write_mesh(Mesh(np.vstack([whole.vertices, [[0, 0, 9]]]), faces[1:]), tmp_path / "torn.ply")
    before = (tmp_path / "torn.ply").read_bytes()
    done = command("check", tmp_path / "torn.ply")
    assert done.returncode == ExitCode.MESH
    assert done.stderr.startswith(f"gnrecon: {tmp_path / 'torn.ply'} does not bound a solid: it is open: 3 edges")
    assert "; it is not consistently oriented" in done.stderr
    assert done.stderr.count("\n") == 1
    found = values(done.stdout)
    assert (found["sound"], found["closed"], found["boundary_edges"], found["unused_vertices"]) == (
        "no",
        "no",
        "3",
        "1",
    )
    assert found["genus"] == "-"
    assert (tmp_path / "torn.ply").read_bytes() == before
    done = command("check", tmp_path / "torn.ply", "--json")
    assert done.returncode == ExitCode.MESH
    assert json.loads(done.stdout)["failures"][0] == "is open: 3 edges have only one face"


def test_vertices_that_are_not_finite_give_json_that_every_reader_takes(tmp_path: Path, command: CommandLine) -> None:
    (tmp_path / "broken.off").write_text(
        "OFF\n4 4 0\nnan 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    )
    done = command("check", tmp_path / "broken.off", "--json")
    assert done.returncode == ExitCode.MESH
    found = json.loads(done.stdout, parse_constant=pytest.fail)
    assert (found["broken_vertices"], found["volume"], found["self_intersecting_faces"]) == (1, None, None)


def test_files_that_cannot_be_read(tmp_path: Path, command: CommandLine) -> None:
    command.refuses(ExitCode.INPUT, "no such file", "check", tmp_path / "missing.ply")
    command.refuses(ExitCode.INPUT, "expected a file", "check", tmp_path)
    (tmp_path / "cloud.xyz").write_text("0 0 0\n1 1 1\n")
    command.refuses(ExitCode.INPUT, "2 points and no faces", "check", tmp_path / "cloud.xyz")
    (tmp_path / "mesh.docx").write_text("x")
    command.refuses(ExitCode.INPUT, "extension '.docx' is not supported", "check", tmp_path / "mesh.docx")
    write_mesh(ball(), tmp_path / "ball.ply")
    (tmp_path / "torn.ply").write_bytes((tmp_path / "ball.ply").read_bytes()[:-5])
    command.refuses(ExitCode.INPUT, "declares 1280 face rows", "check", tmp_path / "torn.ply")
    command.refuses(ExitCode.USAGE, "Missing argument", "check")


@pytest.mark.parametrize("command", [["check", "cube.obj", "--json"], ["schema"]])
def test_a_light_command_loads_no_torch_and_no_open3d(tmp_path: Path, command: list[str]) -> None:
    write_mesh(cube(), tmp_path / "cube.obj")
    code = (
        "import sys\n"
        "from gnrecon.cli.app import main\n"
        "try:\n    main(sys.argv[1:])\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "assert not {'torch', 'open3d', 'skimage'} & set(sys.modules), 'heavy'\n"
    )
    done = subprocess.run([sys.executable, "-c", code, *command], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
