"""The benchmark of shape learning: nested differentiation takes the same step, and the figures are written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from benchmarks import shape_learning
from benchmarks.__main__ import main as bench
from benchmarks.shape_learning import closed_step, nested_step, papers_step

from gnrecon.field import Network
from gnrecon.least_squares import Cholesky
from gnrecon.residuals import eikonal, interface, mean_curvature
from gnrecon.runtime.errors import ExitCode
from gnrecon.shape_learning.frozen_points import FrozenProblem, FrozenTerm


def test_nested_differentiation_takes_the_same_step() -> None:
    network = Network((6, 5))
    generator = torch.Generator().manual_seed(0)
    theta = network.initial(generator)
    points = torch.randn(3, 40, 3, generator=generator, dtype=torch.float64)
    terms = [
        FrozenTerm("interface", interface, points[0], None, 2.0),
        FrozenTerm("eikonal", eikonal, points[1], None, 0.5),
        FrozenTerm("mean curvature", mean_curvature, points[2], None, 1.0),
    ]
    problem = FrozenProblem(network, terms, theta)
    closed = closed_step(problem, theta, 1e-6, Cholesky())
    for step in (nested_step, papers_step):
        nested = step(problem, theta, 1e-6)
        assert float((closed - nested).norm()) < 1e-6 * float(nested.norm())


def test_both_ways_are_timed_on_the_same_step() -> None:
    figures = shape_learning.step_figures(0, steps=2, our_repetitions=1, nested_repetitions=1)
    for which in ("first", "later"):
        step = figures[which]
        assert step["parameters"] == 1217
        assert 2700 < step["rows"] <= 2800
        assert step["error"] < 0.2
        assert step["papers_speedup"] == pytest.approx(step["papers_seconds"] / step["seconds"])
        assert step["speedup"] == pytest.approx(step["nested_seconds"] / step["seconds"])


def test_the_figures_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step = {
        "rows": 3,
        "parameters": 2,
        "seconds": 0.1,
        "moving_seconds": 0.2,
        "factored_seconds": 0.3,
        "nested_seconds": 3.0,
        "papers_seconds": 4.0,
        "speedup": 30.0,
        "papers_speedup": 40.0,
        "error": 1e-2,
    }
    monkeypatch.setattr(shape_learning, "step_figures", lambda seed: {"first": step, "later": step, "seed": seed})
    path = tmp_path / "figures.json"
    words = ["--problems", "cone", "--optimisers", "gn", "--budget", "0.01", "--json", str(path)]
    assert bench(["learn", *words]) == ExitCode.OK
    written = json.loads(path.read_text())
    assert written["step"]["later"]["speedup"] == 30.0
    (one,) = written["figures"]
    assert (one["problem"], one["optimiser"], one["seed"]) == ("cone", "gn", 0)
    assert np.isfinite(one["loss"])
    assert one["chamfer"] > 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "30.0 times as long" in printed
    assert "cone" in printed
