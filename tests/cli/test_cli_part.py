"""``gnrecon learn bracket``: a closed part and how well it keeps to its design, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from command_line import CommandLine

from gnrecon.export import verify_file
from gnrecon.io import read_mesh
from gnrecon.runtime.errors import ExitCode
from gnrecon.shape_learning import ShapeLearningParameters, bracket


@pytest.fixture
def gnrecon(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


def test_a_few_steps_of_the_sample(gnrecon: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = replace(
        ShapeLearningParameters.part, widths=(8, 8), frequencies=(6.0, 2.0), pool_points=30_000, component_cells=32
    )
    monkeypatch.setattr("gnrecon.cli.learn_problem.bracket", partial(bracket, parameters=quick))
    mesh, report = tmp_path / "part.ply", tmp_path / "r.json"
    words = ("bracket", "-o", mesh, "--report", report, "--steps", 2, "--resolution", 48, "--curvature", "--clip", 1000)
    done = gnrecon("learn", *words)
    assert done.returncode == 0, done.stderr
    facts = verify_file(mesh)
    assert facts.closed
    # In millimetres, as the region's file is.
    part = read_mesh(mesh)
    assert 80 < part.vertices[:, 0].max() - part.vertices[:, 0].min() < 115
    assert {"mean_curvature", "gauss_curvature"} <= set(part.attributes)
    design = json.loads(report.read_text())["design"]
    assert design["components"] >= 1
    assert len(design["attachment"]) == 3
    assert 0 <= design["violations"] <= 1
    assert f"{design['violations']:.2%} of the surface is outside" in done.stderr


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("catenoid", "--clip", "100"), "A design is for the problem bracket only"),
        (("bracket", "--region", "region.stl"), "both --region and --interfaces"),
        (("bracket", "--interfaces-frame", "0,0,0,1"), "--interfaces-frame needs --interfaces"),
        (("bracket", "--clip", "-1"), "clipped at -1"),
        (("bracket", "--region", "a.stl", "--interfaces", "b.stl", "--interfaces-frame", "1,2,3"), "X,Y,Z,SCALE"),
        (("bracket", "--region", "a.stl", "--interfaces", "b.stl", "--interfaces-frame", "1,2,3,0"), "X,Y,Z,SCALE"),
    ],
)
def test_what_makes_no_sense_is_refused(
    gnrecon: CommandLine, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    gnrecon.refuses(ExitCode.USAGE, sentence, "learn", *words, "-o", tmp_path / "part.ply")
    assert not (tmp_path / "part.ply").exists()


def test_a_design_that_is_missing_is_refused(gnrecon: CommandLine, tmp_path: Path) -> None:
    words = ("--region", tmp_path / "a.stl", "--interfaces", tmp_path / "b.stl", "-o", tmp_path / "part.ply")
    gnrecon.refuses(ExitCode.INPUT, "There is no file", "learn", "bracket", *words)
