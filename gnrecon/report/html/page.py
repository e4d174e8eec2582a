"""Makes a page of a run: one HTML file with the report, the mesh and the scan, which needs no network."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.geometry.statistics import Histogram
from gnrecon.report.html import facts
from gnrecon.report.html.charts import bars, convergence, quality
from gnrecon.report.html.scales import count, css, figure, ramp
from gnrecon.report.html.viewer import Layer, layers, model
from gnrecon.report.report_parameters import ChartLayout
from gnrecon.runtime.errors import MeshError
from gnrecon.runtime.files import write_text


def write_page(
    path: str | Path, report: Mapping[str, Any], mesh: Mesh, cloud: PointCloud | None = None, overwrite: bool = False
) -> None:
    """Write a run's page to an HTML file, atomically.

    Parameters
    ----------
    path : path
    report : dict
        As `Reconstruction.report`; ``mesh`` is required, other parts are shown where present.
    mesh : Mesh
        In file units; its attributes become the model's colours.
    cloud : PointCloud, optional
        The scan, in file units.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    MeshError
        When the mesh has no faces.
    OutputError
        When the file cannot be written.
    """
    write_text(path, page_text(report, mesh, cloud), overwrite)


def page_text(report: Mapping[str, Any], mesh: Mesh, cloud: PointCloud | None = None) -> str:
    """Return the page as text; parameters and errors are those of `write_page`."""
    if not len(mesh.faces):
        raise MeshError("The mesh has no faces, so there is nothing to show.")
    origins = {one["name"]: one["origin"] for one in report.get("attributes") or []}
    unsupported = report["mesh"].get("invented_beyond")
    shown = layers(mesh, origins, {} if unsupported is None else {"distance": unsupported})
    packed = model(mesh, cloud, shown, solid=bool(report["mesh"]["closed"]))
    environment = Environment(
        loader=FileSystemLoader(_assets()),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"count": count, "figure": figure}
    return environment.get_template("page.html.j2").render(
        report=report,
        facts=facts,
        model=packed,
        layers=[(layer, _legend(layer)) for layer in shown],
        colored="colors" in mesh.attributes or (cloud is not None and "colors" in cloud.attributes),
        residuals=_residuals(report),
        convergence=convergence((report.get("fit") or {}).get("history") or []),
        quality=_quality(mesh),
        style=_verbatim("page.css"),
        library=_verbatim("three.bundle.min.js"),
        program=Markup("\n").join(map(_verbatim, ("shaders.js", "scene.js", "viewer.js", "controls.js"))),
    )


def style_text() -> str:
    """Return the page's style sheet, for other pages in the same style."""
    return _verbatim("page.css")


def _assets() -> Path:
    return Path(__file__).parent / "assets"


def _verbatim(name: str) -> Markup:
    return Markup((_assets() / name).read_text(encoding="utf-8"))


def _legend(layer: Layer) -> Markup:
    colors = [css(color) for color in ramp(layer.kind.ramp)[::4]]
    within = layer.beyond is not None and layer.low < layer.beyond < layer.high
    layout = ChartLayout(width=300, height=140)  # for the narrow panel
    return bars(layer.histogram, layer.unit, strip=colors, layout=layout, mark=layer.beyond if within else None)


def _residuals(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Chart, figures and words for each kind of residual that the report holds."""
    found = (report.get("fit") or {}).get("residuals")
    if not found:
        return []
    kinds = (
        ("distance", "Distance of the points", "signed distance, file units", "", 0.0),
        ("angle", "Angle to the normals", "degrees", "°", None),
    )
    return [
        {
            "title": title,
            "chart": bars(Histogram(**found[name]["histogram"]), label, mark=mark),
            "figures": [
                facts.Fact(words, figure(found[name][key]) + unit)
                for words, key in (("median", "median"), ("RMS", "rms"), ("95 % below", "p95"), ("largest", "max"))
            ],
        }
        for name, title, label, unit, mark in kinds
    ]


def _quality(mesh: Mesh) -> list[dict[str, Any]]:
    measured = quality(mesh)
    return [
        {
            "title": "Angles",
            "chart": bars(measured.angles, "degrees", mark=60.0),
            "figures": measured.angle_figures,
        },
        {"title": "Edge lengths", "chart": bars(measured.edges, "file units"), "figures": measured.edge_figures},
    ]
