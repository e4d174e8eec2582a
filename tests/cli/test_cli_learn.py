"""``gnrecon learn``: an open surface that is said to be one, its report, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import CommandLine

from gnrecon.export import verify_file
from gnrecon.io import read_cloud, read_mesh
from gnrecon.runtime.errors import ExitCode


@pytest.fixture
def gnrecon(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


def test_a_few_steps_of_the_catenoid(gnrecon: CommandLine, tmp_path: Path) -> None:
    mesh, report = tmp_path / "catenoid.ply", tmp_path / "r.json"
    words = ("catenoid", "-o", mesh, "--report", report, "--steps", 2, "--resolution", 24, "--curvature", "--verbose")
    done = gnrecon("learn", *words)
    assert done.returncode == 0, done.stderr
    facts = verify_file(mesh, bordered=True)
    assert not facts.closed
    assert {"mean_curvature", "gauss_curvature"} <= set(read_mesh(mesh).attributes)
    written = json.loads(report.read_text())
    assert written["chamfer"] == written["best"]["chamfer"] > 0
    assert written["loss"] == pytest.approx(sum(written["best"]["shares"].values()))
    assert written["loss_history"][0] > written["loss_history"][-1]
    lengths = {len(written[f"{name}_history"]) for name in ("loss", "chamfer", "seconds", "step")}
    assert lengths == {len(written["history"])}
    assert written["step_history"][0] == 0
    assert written["mesh"]["faces"] == facts.faces
    assert written["mesh"]["volume"] is None
    assert "clipped" in written["mesh"]["guarantee"]
    assert written["network"]["parameters"] == 1217
    assert "open, edge-manifold" in done.stderr
    assert done.stderr.count("Step 0") == 1
    again = tmp_path / "again.ply"
    assert gnrecon("learn", "catenoid", "-o", again, *words[5:-1], "--quiet").stderr == ""
    assert again.read_bytes() == mesh.read_bytes()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("klein-bottle",), "catenoid, enneper, cone"),
        (("cone", "--optimiser", "sgd"), "gn, lbfgs, adam"),
        (("cone", "--budget", "0"), "budget"),
        (("cone", "--steps", "0"), "steps"),
        (("cone", "--resolution", "2"), "resolution"),
        (("cone", "--threads", "0"), "threads"),
        (("cone", "--wider", "-1"), "at least 0"),
        (("cone", "--wider", "2", "--optimiser", "adam"), "Gauss-Newton only"),
        (("cone", "--share", "0.2"), "--share and --data are for scans, not for cone"),
        (("bunny", "--share", "1.5"), "above 0 and at most 1"),
    ],
)
def test_what_makes_no_sense_is_refused(
    gnrecon: CommandLine, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    gnrecon.refuses(ExitCode.USAGE, sentence, "learn", *words, "-o", tmp_path / "mesh.ply")
    assert not list(tmp_path.iterdir())


def test_an_existing_mesh_is_kept(gnrecon: CommandLine, tmp_path: Path) -> None:
    kept = tmp_path / "mesh.ply"
    kept.write_text("mine")
    gnrecon.refuses(ExitCode.OUTPUT, "exists already", "learn", "cone", "-o", kept)
    assert kept.read_text() == "mine"


def test_the_papers_scans_are_told_where_they_are_missing(gnrecon: CommandLine, tmp_path: Path) -> None:
    folder, mesh = tmp_path / "data", tmp_path / "mesh.ply"
    folder.mkdir()
    gnrecon.refuses(ExitCode.INPUT, "--data names the folder that holds bun_zipper.ply", "learn", "bunny", "-o", mesh)
    words = ("learn", "rockerarm", "--data", folder, "-o", mesh)
    gnrecon.refuses(ExitCode.INPUT, "does not hold rocker-arm.off", *words)
    assert not mesh.exists()


def test_a_scan_of_ones_own_comes_back_in_its_own_coordinates(
    gnrecon: CommandLine, tmp_path: Path, repository: Path
) -> None:
    mesh, report = tmp_path / "mesh.ply", tmp_path / "r.json"
    scan = repository / "sample_data" / "bracket_sparse.ply"
    words = ("-o", mesh, "--report", report, "--steps", 1, "--share", 0.1, "--resolution", 24, "--wider", 1)
    done = gnrecon("learn", scan, *words)
    assert done.returncode == 0, done.stderr
    written = json.loads(report.read_text())
    assert written["network"] == {"widths": [32, 32, 32], "activation": "sine", "parameters": 2273}
    assert written["wider"] == 1
    assert written["chamfer"] < 0.3
    lower, upper = (getattr(read_cloud(scan).points, end)(axis=0) for end in ("min", "max"))
    middle = read_mesh(mesh).vertices.mean(axis=0)
    assert (middle > lower).all()
    assert (middle < upper).all()
