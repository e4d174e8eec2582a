"""``gnrecon learn``: an open surface that is said to be one, its report, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import CommandLine

from gnrecon.errors import ExitCode
from gnrecon.export import verify_file
from gnrecon.io import read_mesh


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
