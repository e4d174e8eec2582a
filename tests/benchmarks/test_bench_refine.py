"""The benchmark of refinement: its shapes are exact, and its figures are what it says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks import remeshing
from benchmarks.remeshing import SHAPES

from gnrecon.export import extract, verify
from gnrecon.runtime.errors import ExitCode


@pytest.mark.parametrize("name", SHAPES)
def test_its_fields_are_distances(name: str, rng: np.random.Generator) -> None:
    shape, _ = SHAPES[name]
    mesh = extract(shape, resolution=24)
    assert verify(mesh).closed
    x = mesh.vertices[rng.permutation(len(mesh.vertices))[:200]] * 0.97
    # On the ridges between two faces there is no gradient.
    slopes = np.linalg.norm(shape.gradient(x), axis=1)
    assert (np.abs(slopes - 1.0) < 1e-4).mean() > 0.9


def test_figures_of_a_shape_with_edges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(remeshing, "SHAPES", {"cylinder": SHAPES["cylinder"]})
    assert remeshing.main(["--json", str(tmp_path / "figures.json")], cells=32) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "cylinder" in shown
    figures = {one["method"]: one for one in json.loads((tmp_path / "figures.json").read_text())["figures"]}
    ours, theirs = figures["remeshed by gnrecon"], figures["remeshed by pymeshlab"]
    assert ours["between_off"] < 0.5 * theirs["between_off"]
    assert ours["vertices_off"] < 1e-6 < theirs["vertices_off"]
    fewer = figures["fewer faces by gnrecon"]
    assert fewer["faces"] == figures["collapsed by pymeshlab"]["faces"] <= figures["extracted"]["faces"] // 10
    assert fewer["between_off"] < 0.5 * figures["collapsed by pymeshlab"]["between_off"]
    assert figures["simplified by gnrecon"]["between_off"] < figures["simplified by manifold3d"]["between_off"]
