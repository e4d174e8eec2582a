"""`gnrecon eval` prints how far a mesh lies from a reference."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import CommandLine, ball, cube

from gnrecon.export import measure
from gnrecon.io import read_mesh, write_mesh
from gnrecon.runtime.errors import ExitCode


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Two spheres about one centre, of radius 1 and 1.01."""
    write_mesh(ball(), tmp_path / "inner.obj")
    write_mesh(ball(1.01), tmp_path / "outer.ply")
    return tmp_path / "inner.obj", tmp_path / "outer.ply"


def test_distances_between_two_spheres(files: tuple[Path, Path], tmp_path: Path, command: CommandLine) -> None:
    words = ("eval", files[0], "--reference", files[1], "--samples", 5000)
    done = command(*words, "--json", tmp_path / "figures.json")
    assert (done.returncode, done.stderr) == (0, "")
    printed = dict(line.split()[:2] for line in done.stdout.splitlines())
    found = json.loads((tmp_path / "figures.json").read_text())
    for name in ("chamfer_mean", "chamfer_rms_paper", "hausdorff", "f_score", "normal_consistency", "radius"):
        assert float(printed[name]) == pytest.approx(found[name], rel=1e-4)
    # The faces of an icosphere lie a little within the sphere, by the same share in both.
    assert found["chamfer_mean"] == pytest.approx(0.01, rel=0.02)
    assert found["hausdorff"] == pytest.approx(0.01, rel=0.1)
    assert found["normal_consistency"] > 0.999
    assert (found["mesh"], found["reference"], found["samples"]) == (str(files[0]), str(files[1]), 5000)
    assert command(*words).stdout == done.stdout
    assert command(*words, "--seed", 1).stdout != done.stdout


def test_the_text_is_what_a_reconstruction_prints(files: tuple[Path, Path], command: CommandLine) -> None:
    done = command("eval", files[0], "--reference", files[1])
    expected = measure(read_mesh(files[0]), read_mesh(files[1])).describe()
    assert done.stdout.splitlines() == expected


def test_a_cloud_is_a_reference_too(files: tuple[Path, Path], tmp_path: Path, command: CommandLine) -> None:
    np.savetxt(tmp_path / "cloud.xyz", 1.01 * ball().vertices)
    done = command("eval", files[0], "--reference", tmp_path / "cloud.xyz", "--samples", 1000)
    assert done.returncode == 0
    assert "reference's nearest point" in done.stdout


def test_what_cannot_be_measured(files: tuple[Path, Path], tmp_path: Path, command: CommandLine) -> None:
    inner, outer = files
    missing = tmp_path / "missing.ply"
    command.refuses(ExitCode.INPUT, f"There is no file {missing}", "eval", missing, "--reference", outer)
    command.refuses(ExitCode.INPUT, f"There is no file {missing}", "eval", inner, "--reference", missing)
    command.refuses(ExitCode.USAGE, "Missing option '--reference'", "eval", inner)
    command.refuses(ExitCode.USAGE, "at least 1", "eval", inner, "--reference", outer, "--samples", 0)
    (tmp_path / "cloud.xyz").write_text("0 0 0\n1 1 nan\n0 1 0\n")
    command.refuses(ExitCode.INPUT, "3 points and no faces", "eval", tmp_path / "cloud.xyz", "--reference", outer)
    done = ("eval", inner, "--reference", tmp_path / "cloud.xyz")
    command.refuses(ExitCode.INPUT, "The reference has 1 points that are not finite", *done)
    (tmp_path / "taken.json").write_text("somebody's work")
    words = ("eval", inner, "--reference", outer, "--samples", 10, "--json")
    command.refuses(ExitCode.OUTPUT, "exists already", *words, tmp_path / "taken.json")
    command.refuses(ExitCode.USAGE, "named twice", *words, outer, "--overwrite")
    command.refuses(ExitCode.OUTPUT, "does not exist", *words, tmp_path / "no" / "figures.json")
    assert (tmp_path / "taken.json").read_text() == "somebody's work"
    assert command(*words, tmp_path / "taken.json", "--overwrite").returncode == 0
    assert json.loads((tmp_path / "taken.json").read_text())["samples"] == 10


def test_a_mesh_that_is_not_sound_is_measured_all_the_same(tmp_path: Path, command: CommandLine) -> None:
    whole = cube()
    write_mesh(whole, tmp_path / "whole.ply")
    (tmp_path / "open.off").write_text("OFF\n3 1 0\n0 0 1\n1 0 1\n0 1 1\n3 0 1 2\n")
    done = command("eval", tmp_path / "open.off", "--reference", tmp_path / "whole.ply", "--samples", 100)
    assert done.returncode == 0
    assert "mesh_to_reference_mean" in done.stdout
