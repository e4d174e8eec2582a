"""The report of a reconstruction as plain values, made from what the steps of the pipeline found.

The steps hand on the records below: what was read, ingested, fitted, meshed and measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gnrecon.export import Attribute, MeshFacts, Metrics, Neighbourhood, Trimming, UnsupportedArea, quality
from gnrecon.export.resolution import Fineness
from gnrecon.fit import Misfit, NeuralSDF
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud, Samples
from gnrecon.ingest import IngestCounts, Layers, Survey, guess_units
from gnrecon.io import Reading
from gnrecon.optim import Solution
from gnrecon.options import Options
from gnrecon.report.report import Stages, plain, versions
from gnrecon.report.schema import SCHEMA_VERSION


@dataclass(frozen=True)
class ScanRead:
    """A scan as it was read, and the reference to measure the mesh against, if any."""

    cloud: PointCloud
    reading: Reading
    reference: Mesh | PointCloud | None


@dataclass(frozen=True)
class Ingested:
    """The points to fit, what was removed, and what is known of the scan; `sheet` is its thinnest, file units."""

    samples: Samples
    counts: IngestCounts
    survey: Survey | None
    layers: Layers | None
    sheet: float | None


@dataclass(frozen=True)
class Fitted:
    """The field, how its fit ended, and its residuals at the fitted points and at those held out."""

    sdf: NeuralSDF
    solution: Solution
    residuals: Misfit
    held_out: Misfit | None


@dataclass(frozen=True)
class MeshedScan:
    """The mesh before it gets attributes, and how far the scan supports it.

    Parameters
    ----------
    mesh : Mesh
        In file units; open where it was trimmed.
    fineness : Fineness
    actions : list of str
        A sentence for each thing that was dropped, refined, repaired or cut.
    neighbourhood : Neighbourhood
        Of the scan's points.
    spacing : float
        Of the scan's points, file units.
    trimming : Trimming, optional
    """

    mesh: Mesh
    fineness: Fineness
    actions: list[str]
    neighbourhood: Neighbourhood
    spacing: float
    trimming: Trimming | None


@dataclass(frozen=True)
class FinishedMesh:
    """The verified mesh with its attributes, and distances to the reference, if there is one."""

    mesh: Mesh
    facts: MeshFacts
    unsupported: UnsupportedArea
    attributes: list[Attribute]
    metrics: Metrics | None


def run_report(
    source: str,
    options: Options,
    stages: Stages,
    scan: ScanRead,
    ingested: Ingested,
    fitted: Fitted,
    surface: MeshedScan,
    finished: FinishedMesh,
) -> dict[str, Any]:
    """Return the report of a run, ready for JSON; `gnrecon.report_schema` describes each field.

    Parameters
    ----------
    source : files of the scan, or the type of another source
    options : in effect
    stages : times and memory
    scan, ingested, fitted, surface, finished : what the steps found
    """
    found = {
        "schema_version": SCHEMA_VERSION,
        "command": None,
        "origin": None,
        "input": source,
        "options": options.as_dict(),
        "versions": versions(),
        "ingest": ingested.counts.as_dict(),
        "frame": {"center": fitted.sdf.frame.center.tolist(), "scale": fitted.sdf.frame.scale},
        "fit": _fit_facts(fitted),
        "mesh": _mesh_facts(finished),
        "trim": None if surface.trimming is None else surface.trimming.as_dict(),
        "reading": scan.reading.as_dict(),
        "scan": scan_facts(ingested.survey, ingested.layers, scan.reading),
        "fineness": surface.fineness.as_dict(),
        "actions": surface.actions,
        "attributes": [{"name": one.name, "origin": one.origin} for one in finished.attributes],
        "metrics": None if finished.metrics is None else finished.metrics.as_dict(),
        "stages": stages.as_list(),
        "resources": stages.resources(),
    }
    values: dict[str, Any] = plain(found)
    return values


def scan_facts(scan: Survey | None, layers: Layers | None, reading: Reading) -> dict[str, Any] | None:
    """Return what is known of a scan as plain values; None where it has too few points."""
    if scan is None:
        return None
    units = guess_units(scan.lower, scan.upper, reading.files)
    found = scan.as_dict() | {"layers": None if layers is None else layers.as_dict()}
    return found | {"units_guess": units.unit, "units_reason": units.reason}


def _fit_facts(fitted: Fitted) -> dict[str, Any]:
    sdf, solution = fitted.sdf, fitted.solution
    return {
        "status": solution.status,
        "method": solution.method,
        "interrupted": solution.interrupted,
        "parameters": sdf.parameters,
        "detail": None if sdf.detail is None else sdf.detail.as_dict(sdf.frame.scale),
        "history": [vars(record) for record in solution.history],
        "residuals": fitted.residuals.as_dict(),
        "held_out": None if fitted.held_out is None else fitted.held_out.as_dict(),
    }


def _mesh_facts(finished: FinishedMesh) -> dict[str, Any]:
    """What the mesh is; an open one has no volume."""
    facts = finished.facts
    guarantee = "closed, oriented 2-manifold" if facts.closed else "oriented edge-manifold with borders"
    found = {
        **facts.as_dict(),
        **finished.unsupported.as_dict(),
        "guarantee": guarantee,
        "quality": quality(finished.mesh).as_dict(),
    }
    return found if facts.closed else found | {"volume": None}
