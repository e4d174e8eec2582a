"""The page as a file: it holds everything, asks for nothing, and leaves out what is missing."""

from __future__ import annotations

import configparser
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import CENTRE, Elements, adorned, buffer, report, scan, scene, torus

from gnrecon.export import verify
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.report.html import page_text, write_page
from gnrecon.report.html.viewer import model as packed_model
from gnrecon.runtime.errors import MeshError, OutputError

ALL_MODES = ["plain", "colors", "error", "sigma", "distance", "mean_curvature", "gauss_curvature", "intensity"]


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return adorned(torus())


@pytest.fixture(scope="module")
def text(mesh: Mesh) -> str:
    return page_text(report(mesh), mesh, scan(mesh))


def modes(text: str) -> list[str | None]:
    return [a["data-to"] for _, a in Elements(text).elements if a.get("data-set") == "mode" and "data-jump" not in a]


def test_nothing_is_fetched(text: str) -> None:
    """Neither by an element nor by a style sheet nor by the program; the browser is told so, too."""
    for tag, attributes in Elements(text).elements:
        assert tag not in ("link", "iframe", "img", "object", "embed", "base"), tag
        assert not {"src", "href", "srcset", "action"} & set(attributes), (tag, attributes)
    assert not re.search(r"@import|url\(", text.split("</style>")[0])
    assert "default-src 'none'" in text
    # The one address within is the name of XHTML's namespace.
    assert set(re.findall(r"https?://[^\"'` )]+", text)) == {"http://www.w3.org/1999/xhtml"}


def test_the_model_is_the_mesh(text: str, mesh: Mesh) -> None:
    model = scene(text)
    places = buffer(text, "positions", "<f4").reshape(-1, 3).astype(float)
    assert np.abs(model["centre"] + model["radius"] * places - mesh.vertices).max() < 1e-5
    assert np.abs(np.array(model["centre"]) - CENTRE).max() < 1e-6
    assert np.array_equal(buffer(text, "faces", "<u4").reshape(-1, 3), mesh.faces)
    shape = buffer(text, "shape", "<i2").reshape(-1, 4) / 32767
    assert np.abs(shape[:, :3] - mesh.normals).max() < 1e-4
    assert 0 < shape[:, 3].min() < shape[:, 3].max() <= 1
    assert model["solid"] is True
    assert model["faces"] == model["all_faces"] == len(mesh.faces)


def test_every_field_of_values_is_a_mode(text: str, mesh: Mesh) -> None:
    assert modes(text) == ALL_MODES
    for index, layer in enumerate(scene(text)["layers"]):
        assert np.allclose(buffer(text, f"layer-{index}", "<f4"), mesh.attributes[layer["name"]], rtol=1e-6)
        assert len(buffer(text, f"ramp-{layer['ramp']}", "u1")) == 3 * 256
        assert layer["low"] < layer["high"]
    assert np.array_equal(buffer(text, "colors", "u1").reshape(-1, 4)[:, :3], mesh.attributes["colors"])
    assert "Weighted mean of the nearest points." in Elements(text).text


def test_the_points_are_the_scan(text: str, mesh: Mesh) -> None:
    model = scene(text)
    places = buffer(text, "points", "<f4").reshape(-1, 3).astype(float)
    assert np.abs(model["centre"] + model["radius"] * places - mesh.vertices).max() < 1e-5
    assert np.abs(buffer(text, "point-normals", "i1").reshape(-1, 4)[:, :3] / 127 - mesh.normals).max() < 0.005
    assert len(buffer(text, "point-colors", "u1")) == 4 * len(mesh.vertices)
    assert model["points"]["shown"] == model["points"]["all"] == len(mesh.vertices)


@pytest.mark.parametrize(
    "words",
    [
        "a scan.ply",
        "A closed, oriented 2-manifold of genus 1 in 1 component, verified.",
        "points 1,200 of 1,300 read",
        "triangles 2,304 on 1,152 vertices",
        "time 1 min 16 s 1.20 GB at most",
        "gnrecon 'a scan.ply' -o mesh.ply --html page.html",
        "scattered off the surface 97 7.5 %",
        "Hausdorff ",
        "half the sum of the two means",
        "95 % below 0.0300",
        "Dropped 2 of 3 components.",
        "Stopped at the limit of 3 steps.",
        "--widths 300",
        "--fraction not given",
        "torch 2.4",
        "cpu, 2 threads",
        "fit 1 min 15 s 1.20 GB",
        "Genus 1",
        "needles 0.0 %",
        "Chord error 0.0125 from the fitted surface, with 256 cells",
        "Without data 12.5 % beyond 0.220 of any point",
        "Hatched: 12.5 % of it, farther than 0.220 from every point.",
        "Held-out residuals",
        "Damping",
    ],
)
def test_the_page_says(text: str, words: str) -> None:
    assert words in Elements(text).text


def test_what_is_missing_is_left_out() -> None:
    mesh = torus()
    bare = Mesh(mesh.vertices, mesh.faces)
    text = page_text({"mesh": verify(bare).as_dict()}, bare)
    shown = Elements(text)
    assert modes(text) == ["plain"]
    assert scene(text)["points"] is None
    assert not [a for _, a in shown.elements if a.get("data-set") == "points"]
    for words in ("reference", "Fit", "Run", "Options", "Versions", "Convergence", "None", "Undefined"):
        assert words not in shown.text, words
    assert "Angles" in shown.text


def test_an_open_surface_is_called_one() -> None:
    whole = torus()
    part = Mesh(whole.vertices, whole.faces[whole.corners[:, :, 2].max(axis=1) < 103])
    text = page_text({"mesh": verify(part).as_dict()}, part)
    assert "A surface in 1 component: open." in Elements(text).text
    assert scene(text)["solid"] is False
    values = report(part) | {"trim": {"distance": 2.0, "area_share": 0.25, "crumbs": 0, "filled": 1}}
    values["mesh"] |= {"guarantee": "oriented edge-manifold with borders", "volume": None}
    said = Elements(page_text(values, part)).text
    assert "An oriented edge-manifold with borders in 1 component, verified." in said
    assert "Cut off 25.0 % beyond 2.00 of any point" in said
    assert "volume" not in said.lower()


def test_heavy_meshes_and_clouds_are_drawn_lightly_and_said_to_be(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gnrecon.report.html.page.model", partial(packed_model, most_faces=1000, most_points=500))
    text = page_text(report(mesh), mesh, scan(mesh))
    model = scene(text)
    assert 500 < model["faces"] <= 1000 < model["all_faces"] == len(mesh.faces)
    assert len(buffer(text, "faces", "<u4")) == 3 * model["faces"]
    vertices = len(buffer(text, "positions", "<f4")) // 3
    assert {len(buffer(text, f"layer-{index}", "<f4")) for index in range(len(model["layers"]))} == {vertices}
    assert len(buffer(text, "points", "<f4")) == 3 * 500
    said = Elements(text).text
    assert f"Drawn with {model['faces']:,} of 2,304 triangles." in said
    assert "Drawn with 500 of 1,152 points." in said


def test_values_and_points_that_are_not_finite() -> None:
    mesh = torus()
    values = np.linspace(0, 1, len(mesh.vertices))
    values[:10] = [np.nan, np.inf, -np.inf, 1e300, -1.7e308] * 2
    nothing = np.full(len(values), np.nan)
    cloud = PointCloud(np.array([[np.nan] * 3, CENTRE, [np.inf] * 3]))
    mesh = mesh.with_attributes({"distance": values, "nothing": nothing, "constant": 0 * values[20] + 0 * nothing.real})
    text = page_text({"mesh": verify(mesh).as_dict()}, mesh, cloud)
    assert modes(text) == ["plain", "distance"]
    assert (buffer(text, "layer-0", "<f4")[:10] < -1e38).all()
    assert scene(text)["points"]["shown"] == 1
    assert (
        scene(page_text({"mesh": verify(mesh).as_dict()}, mesh, PointCloud(np.full((2, 3), np.nan))))["points"] is None
    )


@pytest.mark.parametrize("value", [0.0, 3.0, -2.5])
def test_values_that_are_all_the_same_have_a_scale(value: float) -> None:
    mesh = torus()
    mesh = mesh.with_attributes({name: np.full(len(mesh.vertices), value) for name in ("error", "sigma", "other")})
    for layer in scene(page_text({"mesh": verify(mesh).as_dict()}, mesh))["layers"]:
        assert layer["low"] < layer["high"]


def test_names_cannot_become_elements(mesh: Mesh) -> None:
    evil = '</script><img src=x onerror="alert(1)">.ply'
    values: dict[str, Any] = {**report(mesh), "input": evil, "command": evil, "actions": [evil]}
    named = mesh.with_attributes({evil: np.zeros(len(mesh.vertices))})
    text = page_text(values, named, scan(mesh))
    assert "img" not in {tag for tag, _ in Elements(text).elements}
    assert evil in modes(text)
    assert evil in [layer["name"] for layer in scene(text)["layers"]]


def test_the_same_run_makes_the_same_bytes(mesh: Mesh, text: str) -> None:
    assert page_text(report(mesh), mesh, scan(mesh)) == text


def test_files_are_written_whole_or_not_at_all(mesh: Mesh, text: str, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    write_page(target, report(mesh), mesh, scan(mesh))
    assert target.read_text(encoding="utf-8") == text
    with pytest.raises(OutputError, match="exists already"):
        write_page(target, report(mesh), mesh)
    empty = Mesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=int))
    with pytest.raises(MeshError, match="no faces"):
        write_page(tmp_path / "empty.html", report(mesh), empty)
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_everything_that_the_page_is_made_of_is_data_of_the_package(repository: Path) -> None:
    config = configparser.ConfigParser()
    config.read(repository / "setup.cfg")
    patterns = config["options.package_data"]["gnrecon.report.html"].split()
    folder = repository / "gnrecon" / "report" / "html" / "assets"
    for path in folder.iterdir():
        if path.is_file() and path.suffix != ".py":
            assert any(path.match(pattern) for pattern in patterns), path.name
    assert (folder / "three.bundle.min.js").stat().st_size < 1_000_000
    assert "MIT License" in (folder / "three.LICENSE.txt").read_text()
