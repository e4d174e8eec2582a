"""The reconstruction of a scan: read, ingest, fit, mesh, verify, report.

Each step is a stage of its own in `gnrecon.io`, `gnrecon.ingest`, `gnrecon.fit` and `gnrecon.export`. `reconstruct`
runs them in order, times them, passes on what users should know, and returns a verified mesh with its report.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.export import (
    Attribute,
    Metrics,
    Neighbourhood,
    measure,
    require_bordered,
    require_sound,
    same_side_distances,
    trim,
    unsupported_area,
    verify_file,
    vertex_error,
)
from gnrecon.export.mesh_field import cells_for_faces, mesh_field
from gnrecon.fit import Misfit, NeuralSDF, Uncertainty, bounds_of, fit
from gnrecon.fit.blocks.store import require_work_folder
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.open_scenes import spacing_ratio
from gnrecon.geometry.point_cloud import PointCloud, Region
from gnrecon.ingest import is_single_sheet, layers_of, prepare, sheet_thickness, survey, without_garbage
from gnrecon.io import (
    Reading,
    as_cloud,
    as_shape,
    cropped,
    read_reference,
    read_scans,
    to_meshio,
    to_open3d,
    to_pymeshlab,
    to_pyvista,
    to_trimesh,
    write_mesh,
)
from gnrecon.optim import Record
from gnrecon.options import Options
from gnrecon.report.estimate import expected_within_memory
from gnrecon.report.html import page_text, result_html, show_page
from gnrecon.report.report import Stages
from gnrecon.report.run_report import FinishedMesh, Fitted, Ingested, MeshedScan, ScanRead, run_report
from gnrecon.report.scan_limits import coarse_parts_remark, few_points_remark, thin_sheet_remark
from gnrecon.runtime.compute_limits import limited, require_device
from gnrecon.runtime.logs import ALREADY_SHOWN
from gnrecon.runtime.parallel import in_background
from gnrecon.version import __version__
from gnrecon.vertex_attributes import AttributeSources, compute_attributes, requested_names, without_unsupported

_log = logging.getLogger(__name__)


class Progress:
    """Callbacks of a running reconstruction; this base class ignores them all.

    Any method may raise `gnrecon.Cancelled` to end the run, which then returns nothing.
    """

    def stage(self, name: str) -> None:
        """Called when a stage begins."""

    def advance(self, share: float) -> None:
        """Called from time to time with the share of the stage that is done, from 0 to 1, never decreasing."""

    def expect(self, fit_seconds: float, mesh_seconds: float) -> None:
        """Called before the fit with the seconds that it and the mesh may take, where such runs were measured."""

    def step(self, record: Record, total: int) -> None:
        """Called after each step of the fit, of `total` at most."""

    def remark(self, sentence: str) -> None:
        """Called with a sentence for the user, such as what was dropped."""


@dataclass(frozen=True)
class Reconstruction:
    """A verified mesh, the field it was extracted from, and the report.

    Parameters
    ----------
    mesh : Mesh
        Oriented 2-manifold in file units: closed, or with borders where it was trimmed or the scan is a sheet.
    sdf : NeuralSDF
    report : dict
        Options, versions, stages, counts, fit history, mesh facts and metrics as plain values, ready for JSON;
        `gnrecon.report_schema` describes each.
    metrics : Metrics, optional
        Distances to the reference, where one was given.
    interrupted : bool
        Whether Ctrl-C stopped the fit early; the mesh is then that of the best field so far.
    uncertainty : Uncertainty, optional
        Standard deviations of the surface, with ``uncertainty=True``.
    cloud : PointCloud, optional
        The scan as it was read, cropped, without coordinates that are not finite or out of all proportion.
    """

    mesh: Mesh
    sdf: NeuralSDF
    report: dict[str, Any]
    metrics: Metrics | None = None
    interrupted: bool = False
    uncertainty: Uncertainty | None = None
    cloud: PointCloud | None = None

    def __repr__(self) -> str:
        kind = "closed" if self.report["mesh"]["closed"] else "open"
        return f"<Reconstruction: {kind} mesh of {len(self.mesh.vertices):,} vertices, {len(self.mesh.faces):,} faces>"

    def _repr_html_(self) -> str:
        """The picture and the facts that a notebook shows."""
        return result_html(self.report, self.mesh, self.cloud)

    def show(self, height: int = 720) -> Path | None:
        """Show the interactive page: below a notebook's cell, `height` pixels high, or else in the web browser.

        Returns the file that the browser shows, which is a temporary one; None in a notebook.
        """
        return show_page(page_text(self.report, self.mesh, self.cloud), height=height)

    def save(
        self, path: str | Path, overwrite: bool = False, *, complete: Callable[[], None] | None = None
    ) -> list[str]:
        """Write the mesh, verify it, call `complete`, give it its name, and return sentences on what was not kept.

        Raises
        ------
        MeshError
            When the mesh as read back is not a closed, oriented 2-manifold or, if trimmed, an oriented edge-manifold.
        OutputError
            When the file cannot be written.
        """

        def verify(file: Path) -> None:
            verify_file(file, bordered=not self.report["mesh"]["closed"])  # the file is verified as the mesh was
            if complete is not None:
                complete()

        mesh = without_unsupported(self.mesh, Path(path), self.report["options"]["attributes"])
        return write_mesh(mesh, path, overwrite, verify)

    def to_trimesh(self) -> Any:
        """Return the mesh as a `trimesh.Trimesh`."""
        return to_trimesh(self.mesh)

    def to_open3d(self) -> Any:
        """Return the mesh as an `open3d.geometry.TriangleMesh`."""
        return to_open3d(self.mesh)

    def to_pymeshlab(self) -> Any:
        """Return the mesh as a `pymeshlab.MeshSet`."""
        return to_pymeshlab(self.mesh)

    def to_pyvista(self) -> Any:
        """Return the mesh as a `pyvista.PolyData`."""
        return to_pyvista(self.mesh)

    def to_meshio(self) -> Any:
        """Return the mesh as a `meshio.Mesh`."""
        return to_meshio(self.mesh)


def reconstruct(
    source: Any,
    normals: npt.ArrayLike | None = None,
    *,
    reference: Any = None,
    format: str | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Reconstruction:
    """Reconstruct a surface from a scan: closed, or open where the scan is a single sheet.

    Parameters
    ----------
    source : path, list of paths, array of shape (N, 3) or (N, 6), PointCloud, or what else `as_cloud` takes
        Points, in any unit, with or without normals: other libraries' clouds and meshes, tensors, named columns.
        Several files are merged by the poses that they hold.
    normals : array of shape (N, 3), optional
        Outward normals that go with an array of points.
    reference : path, Mesh, PointCloud, or another library's, optional
        Known surface to measure the mesh against.
    format : str, optional
        Format of the scan's file, such as ``"ply"``; by default its extension.
    progress : Progress, optional
        Receives stages, steps and remarks; it may end the run by raising `gnrecon.Cancelled`.
    **options
        The fields of `Options`, by name.

    Raises
    ------
    UsageError, InputError, FitError, MeshError, MemoryLimitError
        See `gnrecon.runtime.errors`; each message is one sentence.
    """
    chosen = Options.of(**options)
    require_device(chosen.device)
    if chosen.work_dir is not None:
        require_work_folder(chosen.work_dir)
    with limited(chosen.threads):
        run = _PipelineRun(source_name(source), chosen, progress or Progress())
        scan = _read(run, source, normals, format, reference)
        ingested, scan = _ingest(run, scan)
        fitted = _fit(run, ingested)
        surface = _trim(run, ingested, _mesh(run, scan, ingested, fitted))
        finished, uncertainty = _finish(run, scan, ingested, fitted, surface)
        report = run_report(run.source, run.options, run.stages, scan, ingested, fitted, surface, finished)
    interrupted = fitted.solution.interrupted
    return Reconstruction(finished.mesh, fitted.sdf, report, finished.metrics, interrupted, uncertainty, scan.cloud)


@dataclass
class _PipelineRun:
    """What all steps of a run share.

    Parameters
    ----------
    source : files of the scan, or the type of another source
    chosen : options as they were given
    progress : of the caller
    options : in effect: a resolution that was not given is filled in once the scan and the field are known
    stages : times and memory
    """

    source: str
    chosen: Options
    progress: Progress
    options: Options = field(init=False)
    stages: Stages = field(init=False)

    def __post_init__(self) -> None:
        self.options = self.chosen
        self.stages = Stages(self.progress.stage, self.chosen.device)
        _log.info("gnrecon %s reconstructs %s.", __version__, self.source)
        _log.debug("Options: %s.", self.chosen)

    def remark(self, sentences: Iterable[str]) -> None:
        """Pass on sentences to the log and to the caller."""
        for sentence in sentences:
            _log.info(sentence, extra=ALREADY_SHOWN)
            self.progress.remark(sentence)

    @property
    def refines_resolution(self) -> bool:
        """Whether the field may raise the resolution, because no size of the faces was given."""
        return self.chosen.resolution is None and self.chosen.edge_length is None and self.chosen.max_error is None


def _read(run: _PipelineRun, source: Any, normals: Any, format: str | None, reference: Any) -> ScanRead:
    """Read the scan and the reference."""
    with run.stages("read"):
        limits = run.options.read_points, run.options.region(), run.options.column_names()
        cloud, reading = read_source(source, normals, format, *limits)
        run.progress.advance(0.5)
        read = read_reference if isinstance(reference, str | Path) else as_shape
        scan = ScanRead(cloud, reading, None if reference is None else read(reference))
    requested_names(cloud, run.options.attributes)  # a misspelt name is refused before the work
    return scan


def _ingest(run: _PipelineRun, scan: ScanRead) -> tuple[Ingested, ScanRead]:
    """Clean and thin the points, orient their normals, choose a resolution; return the scan without garbage, too."""
    with run.stages("ingest"), in_background(lambda: survey(scan.cloud)) as surveyed:
        samples, counts = prepare(scan.cloud, **run.options.ingest(), advance=run.progress.advance)
        points, noise = samples.frame.to_world(samples.points), (samples.noise or 0.0) * samples.frame.scale
        sheet = sheet_thickness(points, samples.normals, noise)
        ingested = Ingested(samples, counts, surveyed(), layers_of(samples, counts.normals), sheet)
    bounds = bounds_of(samples)
    run.options = run.options.for_scan(points, bounds, sheet)
    run.options.require_reachable(bounds)
    if (expected := expected_within_memory(scan.reading.points, len(samples), bounds, run.options)) is not None:
        run.progress.expect(expected.fit_seconds, expected.mesh_seconds)
    layers, cells, longest = ingested.layers, run.options.mesh().cells(bounds), float(np.ptp(bounds, axis=0).max())
    warnings = few_points_remark(points) + ([] if layers is None else [layers.describe()])
    warnings += coarse_parts_remark(points, longest / cells)
    warnings += thin_sheet_remark(sheet, layers.offset if layers and samples.estimated else None, cells, longest)
    run.remark([*scan.reading.remarks(), *counts.remarks(), *warnings])
    return ingested, replace(scan, cloud=without_garbage(scan.cloud))


def _fit(run: _PipelineRun, ingested: Ingested) -> Fitted:
    """Fit the field, and measure its residuals."""
    options, samples = run.options, ingested.samples
    total = options.fit().steps_for(len(samples))

    def step(record: Record) -> None:
        _log.debug("Step %d of at most %d: %s.", record.step, total, record)
        run.progress.step(record, total)

    with run.stages("fit"):
        sdf, solution = fit(
            samples, options.fit(), step, run.progress.advance, options.work_dir, options.block_scheduler
        )
        residuals = Misfit.of(sdf, samples)
        held_out = None if samples.held_out is None else Misfit.of(sdf, samples.held_out)
    run.remark([solution.status])
    if held_out is not None:
        run.remark([f"At {ingested.counts.held_out} points held out of the fit: {held_out.describe()}"])
    return Fitted(sdf, solution, residuals, held_out)


def _mesh(run: _PipelineRun, scan: ScanRead, ingested: Ingested, fitted: Fitted) -> MeshedScan:
    """Mesh the field, so finely that faces are no farther off the surface than the field is."""
    sdf, samples = fitted.sdf, ingested.samples
    if run.refines_resolution and (cells := run.options.resolution) is not None:
        run.options = replace(run.options, resolution=cells_for_faces(sdf, cells, ingested.sheet, len(samples)))
    # With the field's own points, so that a saved field makes the same mesh again.
    meshed = mesh_field(sdf, run.options.mesh(), data=sdf.data, stages=run.stages, advance=run.progress.advance)
    around = Neighbourhood(scan.cloud.points)
    spacing = ingested.counts.half_line_distance or around.spacing()
    return MeshedScan(meshed.mesh, meshed.fineness, meshed.actions, around, spacing, None)


def _trim(run: _PipelineRun, ingested: Ingested, surface: MeshedScan) -> MeshedScan:
    """Cut off what no points on the same side support, where ``trim`` or ``open`` was given, or the scan is a sheet."""
    samples, mesh = ingested.samples, surface.mesh
    may_be_open = run.options.trim is None and run.options.open is not False
    one_sided = may_be_open and is_single_sheet(samples.points, samples.normals)
    sheet = one_sided and run.options.open is None and ingested.layers is None
    spacing = surface.spacing * (spacing_ratio(samples.points, samples.normals) if one_sided else 1.0)
    reach = run.options.trim_at(spacing, sheet)
    if reach is not None:
        with run.stages("trim"):
            distances, points = surface.neighbourhood.distances(mesh.vertices), samples.frame.to_world(samples.points)
            distances = same_side_distances(mesh, distances, points, samples.normals, reach, one_sided=one_sided)
            # A reach that the user gave is where the surface ends.
            mesh, trimming = trim(mesh, distances, reach, overhang=None if run.options.trim else spacing)
        actions = [*surface.actions, *trimming.describe(sheet)]
        surface = replace(surface, mesh=mesh, actions=actions, trimming=trimming)
    run.remark(surface.actions)
    return surface


def _finish(
    run: _PipelineRun, scan: ScanRead, ingested: Ingested, fitted: Fitted, surface: MeshedScan
) -> tuple[FinishedMesh, Uncertainty | None]:
    """Verify the mesh, give its vertices attributes, and measure it against the reference."""
    mesh, trimming = surface.mesh, surface.trimming
    with run.stages("verify"):
        facts = require_bordered(mesh) if trimming is not None and trimming.area_share else require_sound(mesh)
    with run.stages("attributes"):
        near, samples = surface.neighbourhood, ingested.samples
        distances = near.distances(mesh.vertices)
        unsupported = unsupported_area(mesh, distances, surface.spacing)
        sources = AttributeSources(mesh, fitted.sdf, scan.cloud, near, distances, samples, run.options)
        mesh, attributes, remarks = compute_attributes(sources, run.progress.advance)
    run.remark([*(unsupported.describe() if trimming is None else []), *remarks])
    finished = FinishedMesh(mesh, facts, unsupported, attributes, None)
    return finished if scan.reference is None else _measure(run, finished, scan.reference), sources.uncertainty


def _measure(run: _PipelineRun, finished: FinishedMesh, reference: Mesh | PointCloud) -> FinishedMesh:
    """Measure the mesh against the reference; its vertices get the attribute ``error``."""
    mesh, attributes = finished.mesh, finished.attributes
    with run.stages("measure"):
        metrics = measure(mesh, reference, seed=run.options.seed, advance=run.progress.advance)
        if run.options.attributes != "none":
            error = Attribute("error", vertex_error(mesh, reference), "signed distance to the reference, file units")
            mesh, attributes = mesh.with_attributes({error.name: error.values}), [*attributes, error]
    return replace(finished, mesh=mesh, attributes=attributes, metrics=metrics)


def read_source(
    source: Any, normals: Any, format: str | None, most: int, region: Region, columns: Sequence[str] = ()
) -> tuple[PointCloud, Reading]:
    """Return the cloud that `reconstruct` makes of its source, and what was read.

    Of files, at most `most` points are kept; of all sources, those in the region.

    Raises `InputError` or `UsageError` when it cannot be read, holds no points, or none lie in the region.
    """
    if files := _files(source):
        return read_scans(files, format, most, region, columns=columns)
    return cropped(as_cloud(source, normals), region)


def source_name(source: Any) -> str:
    """Return the source for the report: its files, or its type."""
    return ", ".join(map(str, _files(source))) or type(source).__name__


def _files(source: Any) -> list[str | Path]:
    """The paths that a source consists of; none where it is something else."""
    if isinstance(source, str | Path):
        return [source]
    paths = list(source) if isinstance(source, list | tuple) else []
    return paths if all(isinstance(path, str | Path) for path in paths) else []
