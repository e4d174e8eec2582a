"""The notebook of the examples runs, and a result shows itself in one."""

from __future__ import annotations

import os
import subprocess
import sys
import types
import webbrowser
from pathlib import Path
from typing import Any

import pytest
from scan_files import torus

import gnrecon
from gnrecon.report.html import notebook

REPOSITORY = Path(__file__).resolve().parents[1]
RUN = """
import sys
import nbformat
from nbclient import NotebookClient

notebook = nbformat.read(sys.argv[1], as_version=4)
client = NotebookClient(notebook, timeout=300)
client.create_kernel_manager().kernel_spec.argv[0] = sys.executable  # whatever other kernel is installed
client.execute()
nbformat.write(notebook, sys.argv[2])
"""
"""In a process of its own, because the sockets of a kernel's client stay open for a while."""

FEW: dict[str, Any] = {"widths": (200,), "steps": 0, "resolution": 24}


@pytest.fixture(scope="module")
def result() -> gnrecon.Reconstruction:
    import numpy as np

    points, normals = torus(600, np.random.default_rng(3))
    return gnrecon.reconstruct(points, normals, **FEW)


def test_the_notebook_runs(tmp_path: Path) -> None:
    for needed in ("nbclient", "ipykernel"):
        pytest.importorskip(needed, reason="the notebook needs nbclient and ipykernel")
    import nbformat

    source, output = REPOSITORY / "examples" / "notebook.ipynb", tmp_path / "run.ipynb"
    unrun = nbformat.read(source, as_version=4)
    assert not [cell for cell in unrun.cells if cell.get("outputs")], "outputs are large: clear them before a commit"
    paths = os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(source), str(output)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    read = nbformat.read(output, as_version=4)
    shown = {
        output.get("data", {}).get("text/plain", output.get("text", "")): output.get("data", {}).get("text/html", "")
        for cell in read.cells
        for output in cell.get("outputs", [])
    }
    text, html = "\n".join(shown), "\n".join(shown.values())
    assert "<PointCloud: 500 points, normals" in text
    assert "<Reconstruction: closed mesh of" in text
    assert "resolution must be a whole number, not 'fine'." in text
    assert "data:image/png;base64," in html
    assert "<iframe srcdoc=" in html
    assert (tmp_path / "ring.ply").is_file()


def test_a_result_is_its_picture_and_facts(result: gnrecon.Reconstruction) -> None:
    html = result._repr_html_()
    assert "A closed, oriented 2-manifold of genus 1 in 1 component, verified." in html
    assert 'src="data:image/png;base64,iVBOR' in html
    assert "triangles" in html
    assert "<script" not in html


def test_a_name_is_no_markup(result: gnrecon.Reconstruction) -> None:
    assert "<b>&lt;i&gt;.ply</b>" in notebook.result_html(
        result.report | {"input": "<i>.ply"}, result.mesh, size=(60, 40)
    )


def test_outside_of_a_notebook_the_browser_shows_the_page(
    result: gnrecon.Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    path = result.show()
    assert path is not None
    assert opened == [path.as_uri()]
    assert "<html" in path.read_text(encoding="utf-8")
    path.unlink()


def test_in_a_notebook_the_page_is_a_frame(result: gnrecon.Reconstruction, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    shell = types.SimpleNamespace(kernel=None)
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    display = types.SimpleNamespace(display_html=lambda text, **_: shown.append(text))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    assert result.show(height=321) is None
    assert shown[0].startswith('<div><iframe srcdoc="&lt;!')
    assert "height:321px" in shown[0]


def test_everything_is_one_line(result: gnrecon.Reconstruction) -> None:
    for shown in (result, result.mesh, result.cloud, result.sdf):
        assert len(repr(shown)) < 120
        assert "\n" not in repr(shown)
    assert (
        repr(result.mesh)
        == f"<Mesh: {len(result.mesh.vertices):,} vertices, {len(result.mesh.faces):,} faces, distance>"
    )
    samples, _ = gnrecon.prepare(result.cloud, holdout=0.1)
    assert repr(samples).startswith("<Samples: 540 points, 60 held out, radius 1.")
    assert repr(result.cloud) == "<PointCloud: 600 points, normals>"
