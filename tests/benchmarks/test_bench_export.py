"""The extraction's benchmark at a small scale: counts, shares and growth, and the comparison with the whole grid."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "export"))

from analytic_fields import Field, shells, sphere
from benchmarks.extraction import main as export
from benchmarks.extraction import sentences
from benchmarks.extraction_run import Counting, compare, same_surface

from gnrecon.export import extract
from gnrecon.field import Siren
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box
from gnrecon.runtime.errors import ExitCode, InputError, OutputError, UsageError


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A small random network that is negative in the middle of its box."""
    field = Siren((12,))
    layers = [(w.clone(), b.clone()) for w, b in field.layout.layers(field.initial(torch.Generator().manual_seed(3)))]
    layers[0][0].mul_(6.0)
    theta = field.layout.flatten(layers)
    frame = Frame(np.array([100.0, 50.0, -3.0]), 4.0)
    box = Box(np.full(3, -1.0), np.array([1.0, 0.8, 0.6]))
    path = tmp_path / "random.gnr"
    NeuralSDF(field, theta, frame, box).save(path)
    return path


def test_the_benchmark_measures_a_model(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "export.json"
    arguments = ["--model", str(model), "--resolutions", "24", "48", "--whole", "32", "--json", str(report)]
    assert export(arguments) == ExitCode.OK
    found: dict[str, Any] = json.loads(report.read_text())
    coarse, fine = found["extractions"]
    assert coarse["nodes"] == 25 * 23 * 21
    for figures in (coarse, fine):
        assert figures["share"] == pytest.approx(figures["evaluations"] / figures["nodes"])
        assert figures["peak_memory_mb"] > 100
    assert fine["faces"] > 3 * coarse["faces"] > 0
    assert found["whole"]["same"]
    assert found["whole"]["faces"] == found["whole"]["our_faces"]
    said = capsys.readouterr().out
    assert "agrees vertex for vertex" in said
    assert f"{fine['evaluations']:,}" in said


def test_the_whole_grid_agrees_or_the_comparison_says_no() -> None:
    figures = compare(Field(shells()), 40)
    assert figures["same"]
    assert figures["farthest"] < 1e-4
    ours = extract(Field(sphere()), resolution=20)
    assert same_surface(ours, ours.vertices[::-1], len(ours.vertices) - 1 - ours.faces, 1e-9) == (True, 0.0)
    turned = ours.faces.copy()
    turned[5] = turned[5, ::-1]
    assert not same_surface(ours, ours.vertices, turned, 1e-9)[0]
    assert not same_surface(ours, ours.vertices + 1e-3, ours.faces, 1e-6)[0]
    assert not same_surface(ours, ours.vertices, ours.faces[1:], 1e-9)[0]
    assert not same_surface(Mesh(ours.vertices[:-1], ours.faces[:0]), ours.vertices, ours.faces, 1e-9)[0]


def test_every_point_is_counted() -> None:
    counting = Counting(Field(sphere()))
    counting.sdf(np.zeros((7, 3)))
    counting.gradient(np.ones((3, 3)))
    counting.sdf(np.zeros((2, 3)))
    assert (counting.values, counting.gradients) == (9, 3)


def test_failures_are_said() -> None:
    report = {"extractions": [{"resolution": 64, "error": "No surface."}], "exponents": {"faces": None}}
    assert sentences(report) == ["64 cells: No surface."]
    report["whole"] = {"error": "Killed."}
    assert sentences(report)[-1] == "The whole grid: Killed."


def test_senseless_arguments_are_refused(model: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at least 16"):
        export(["--model", str(model), "--resolutions", "8"])
    with pytest.raises(InputError, match="no file"):
        export(["--scan", str(tmp_path / "none.ply")])
    with pytest.raises(OutputError, match="folder does not exist"):
        export(["--model", str(model), "--json", str(tmp_path / "none" / "a.json")])
