"""The main job: a scan in, a verified watertight mesh out.

The way of the data: file -> cloud -> samples -> fitted field -> mesh -> report. Every stage is a function of its own in
`gnrecon.io`, `gnrecon.ingest`, `gnrecon.fit` and `gnrecon.export`; here they are called in order, timed, and reported.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy.typing as npt
import torch

from gnrecon.export import (
    Attribute,
    MeshFacts,
    Metrics,
    Neighbourhood,
    Trimming,
    UnsupportedArea,
    measure,
    quality,
    require_bordered,
    require_sound,
    trim,
    unsupported_area,
    verify_file,
    vertex_error,
)
from gnrecon.export.mesh_field import cells_for_curvature, mesh_field
from gnrecon.fit import Misfit, NeuralSDF, Uncertainty, bounds_of, fit
from gnrecon.fit.blocks.store import require_work_folder
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud, Region
from gnrecon.ingest import IngestCounts, Layers, Survey, guess_units, layers_of, prepare, survey
from gnrecon.io import (
    Reading,
    as_cloud,
    as_shape,
    cropped,
    read_reference,
    read_scans,
    to_open3d,
    to_pymeshlab,
    to_trimesh,
    write_mesh,
)
from gnrecon.optim import Record, Solution
from gnrecon.options import Options
from gnrecon.report.report import SCHEMA_VERSION, Stages, plain, versions
from gnrecon.runtime.errors import GnreconError, MemoryLimitError, UsageError
from gnrecon.runtime.logs import TOLD
from gnrecon.runtime.parallel import having_threads
from gnrecon.version import __version__
from gnrecon.vertex_attributes import Sources, adorn, fitting, wanted

_log = logging.getLogger(__name__)


class Progress:
    """What a caller may want to know while a reconstruction runs; this one ignores everything.

    Any method may raise `gnrecon.Cancelled` to end the run, which then returns nothing.
    """

    def stage(self, name: str) -> None:
        """Called when a stage begins."""

    def advance(self, share: float) -> None:
        """Called now and then with the share of the stage that is done, from 0 to 1 and never less than before."""

    def step(self, record: Record, total: int) -> None:
        """Called after each Gauss-Newton step, of `total` at most."""

    def remark(self, sentence: str) -> None:
        """Called with what a user should know, such as what was dropped."""


@dataclass(frozen=True)
class Reconstruction:
    """A verified mesh, the field it was extracted from, and the report.

    Parameters
    ----------
    mesh : Mesh
        Closed, oriented 2-manifold, in file units; with borders where it was trimmed.
    sdf : NeuralSDF
    report : dict
        Options, versions, stages, counts, fit history, mesh facts and metrics as plain values, ready for JSON;
        `gnrecon.report_schema` describes each.
    metrics : Metrics, optional
        Distances to the reference, where one was given.
    interrupted : bool
        Whether the fit was stopped early by Ctrl-C; the mesh then shows the best field until then.
    uncertainty : Uncertainty, optional
        Standard deviations of the surface, where they were asked for.
    cloud : PointCloud, optional
        The scan as it was read, without what was cropped.
    """

    mesh: Mesh
    sdf: NeuralSDF
    report: dict[str, Any]
    metrics: Metrics | None = None
    interrupted: bool = False
    uncertainty: Uncertainty | None = None
    cloud: PointCloud | None = None

    def save(self, path: str | Path, overwrite: bool = False) -> list[str]:
        """Write the mesh atomically, reading it back and verifying it first.

        Returns sentences about what the format could not hold, such as attributes or digits.

        Raises
        ------
        MeshError
            When the mesh as read back is no closed, oriented 2-manifold; of a trimmed one, no oriented edge-manifold.
        OutputError
            When the file cannot be written.
        """
        # Only trimming makes a mesh open; it was verified as what it is, and so is the file.
        bordered = not self.report["mesh"]["closed"]
        mesh = fitting(self.mesh, Path(path), self.report["options"]["attributes"])
        return write_mesh(mesh, path, overwrite, verify=lambda written: _verify(written, bordered))

    def to_trimesh(self) -> Any:
        """Return the mesh as a `trimesh.Trimesh`."""
        return to_trimesh(self.mesh)

    def to_open3d(self) -> Any:
        """Return the mesh as an `open3d.geometry.TriangleMesh`."""
        return to_open3d(self.mesh)

    def to_pymeshlab(self) -> Any:
        """Return the mesh as a `pymeshlab.MeshSet`."""
        return to_pymeshlab(self.mesh)


def reconstruct(
    source: Any,
    normals: npt.ArrayLike | None = None,
    *,
    reference: Any = None,
    format: str | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Reconstruction:
    """Reconstruct a closed surface from a scan.

    Parameters
    ----------
    source : path, list of paths, array of shape (N, 3) or (N, 6), PointCloud, or whatever else `as_cloud` takes
        Points, in any unit, with or without normals: other libraries' clouds and meshes, tensors, named columns.
        Several files are merged, after the poses that they hold.
    normals : array of shape (N, 3), optional
        Outward normals that go with an array of points.
    reference : path, Mesh, PointCloud, or another library's, optional
        Truth to measure the mesh against.
    format : str, optional
        Extension that says how the scan's file is read, such as ``"ply"``; by default its own.
    progress : Progress, optional
        Told of stages, steps and remarks; it may end the run by raising `gnrecon.Cancelled`.
    **options
        The fields of `Options`, by name.

    Raises
    ------
    UsageError, InputError, FitError, MeshError, MemoryLimitError
        See `gnrecon.runtime.errors`; each says in one sentence what is wrong.
    """
    chosen = Options.of(**options)
    require_device(chosen.device)
    if chosen.work_dir is not None:
        require_work_folder(chosen.work_dir)
    with limited(chosen.threads):
        return _run(
            lambda: read_source(source, normals, format, chosen.read_points, chosen.region()),
            source,
            reference,
            progress or Progress(),
            chosen,
        )


@contextmanager
def limited(threads: int | None) -> Iterator[None]:
    """Run a block with so many of torch's threads (None: as many as before), and say so where memory does not suffice.

    Other threads of the program, and those that it starts later, have as many of torch's threads as before.

    Raises
    ------
    MemoryLimitError
        When an allocation in the block failed.
    """
    try:
        with having_threads(threads):
            yield
    except GnreconError:  # among them a MemoryLimitError, which is a MemoryError and has said already what is too large
        raise
    except MemoryError as error:
        raise _out_of_memory(error) from error
    except RuntimeError as error:
        # torch reports a failed allocation as a RuntimeError, on the CPU by its text alone.
        if isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error):
            raise _out_of_memory(error) from error
        raise


def _run(
    read: Callable[[], tuple[PointCloud, Reading]], source: Any, reference: Any, progress: Progress, options: Options
) -> Reconstruction:
    stages = Stages(progress.stage, options.device)
    _log.info("gnrecon %s reconstructs %s.", __version__, _named(source))
    _log.debug("Options: %s.", options)

    def remark(sentence: str) -> None:
        _log.info(sentence, extra=TOLD)
        progress.remark(sentence)

    def step(record: Record) -> None:
        _log.debug("Step %d of at most %d: %s.", record.step, total, record)
        progress.step(record, total)

    with stages("read"):
        cloud, reading = read()
        progress.advance(0.5)
        truth = _reference(reference)
    wanted(cloud, options.attributes)  # a misspelt name is refused before the work
    with stages("ingest"):
        samples, counts = prepare(cloud, **options.ingest(), advance=progress.advance)
        scan, layers = survey(cloud), layers_of(samples, counts.normals)
    free = options.resolution is None and options.edge_length is None and options.max_error is None
    options = options.for_scan(samples.frame.to_world(samples.points), bounds_of(samples))
    options.mesh().cells(bounds_of(samples))  # an impossible edge length is refused before the work
    warnings = [] if layers is None else [layers.describe()]
    for sentence in [*reading.remarks(), *counts.remarks(), *warnings]:
        remark(sentence)
    with stages("fit"):
        total = options.fit().steps_for(len(samples))
        sdf, solution = fit(samples, options.fit(), step, progress.advance, options.work_dir, options.block_scheduler)
        residuals = Misfit.of(sdf, samples)
        unseen = None if samples.held_out is None else Misfit.of(sdf, samples.held_out)
    remark(solution.status)
    if unseen is not None:
        remark(f"At {counts.held_out} points that the fit never saw: {unseen.describe()}")
    if free and options.resolution is not None:
        options = replace(options, resolution=cells_for_curvature(sdf, options.resolution))
    # The field's own points, so that a saved field makes the same mesh again.
    meshed = mesh_field(sdf, options.mesh(), data=sdf.data, stages=stages, advance=progress.advance)
    mesh, actions = meshed.mesh, meshed.actions
    around = Neighbourhood(cloud.points)
    spacing, trimming = around.spacing(), None
    reach = options.trim_at(spacing)
    if reach is not None:
        with stages("trim"):
            mesh, trimming = trim(mesh, around.distances(mesh.vertices), reach)
        actions = [*actions, *trimming.describe()]
    for sentence in actions:
        remark(sentence)
    with stages("verify"):
        facts = require_bordered(mesh) if trimming is not None and trimming.area_share else require_sound(mesh)
    with stages("attributes"):
        distances = around.distances(mesh.vertices)
        unsupported = unsupported_area(mesh, distances, spacing)
        sources = Sources(mesh, sdf, cloud, around, distances, samples, options)
        mesh, attributes, remarks = adorn(sources, progress.advance)
    for sentence in [*(unsupported.describe() if trimming is None else []), *remarks]:
        remark(sentence)
    metrics = None
    if truth is not None:
        with stages("measure"):
            metrics = measure(mesh, truth, seed=options.seed, advance=progress.advance)
            if options.attributes != "none":
                error = Attribute("error", vertex_error(mesh, truth), "signed distance to the reference, file units")
                mesh, attributes = mesh.with_attributes({error.name: error.values}), [*attributes, error]
    surface = _surface(mesh, facts, unsupported, trimming) | {
        "reading": reading.as_dict(),
        "scan": described(scan, layers, reading),
        "fineness": meshed.fineness.as_dict(),
    }
    report = _report(
        source, options, stages, counts, solution, (residuals, unseen), sdf, surface, actions, attributes, metrics
    )
    return Reconstruction(mesh, sdf, report, metrics, solution.interrupted, sources.uncertainty, cloud)


def require_device(device: str) -> None:
    """Refuse a device that torch does not have.

    Raises
    ------
    UsageError
        When the device is unknown or not there.
    """
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise UsageError(f"The device is {device!r}, but must be cpu or cuda.")
    if kind == "cuda" and not torch.cuda.is_available():
        raise UsageError("The device is 'cuda', but torch sees no CUDA GPU; `gnrecon doctor` tells what it sees.")


def read_source(source: Any, normals: Any, format: str | None, most: int, region: Region) -> tuple[PointCloud, Reading]:
    """Return the cloud that `reconstruct` makes of its source, and what was read.

    Of files, at most `most` points are kept; of all sources, those in the region.

    Raises
    ------
    InputError, UsageError
        When it cannot be read, is nothing that holds points, or none lie in the region.
    """
    if files := _files(source):
        return read_scans(files, format, most, region)
    return cropped(as_cloud(source, normals), region)


def described(scan: Survey | None, layers: Layers | None, reading: Reading) -> dict[str, Any] | None:
    """Return what is known of a scan as plain values; None where it has too few points."""
    if scan is None:
        return None
    units = guess_units(scan.lower, scan.upper, reading.files)
    found = scan.as_dict() | {"layers": None if layers is None else layers.as_dict()}
    return found | {"units_guess": units.unit, "units_reason": units.reason}


def _files(source: Any) -> list[str | Path]:
    """The paths that a source consists of; none where it is something else."""
    if isinstance(source, str | Path):
        return [source]
    paths = list(source) if isinstance(source, list | tuple) else []
    return paths if all(isinstance(path, str | Path) for path in paths) else []


def _named(source: Any) -> str:
    """The source for the report: its files, or its type."""
    return ", ".join(map(str, _files(source))) or type(source).__name__


def _reference(reference: Any) -> Mesh | PointCloud | None:
    if reference is None:
        return None
    return read_reference(reference) if isinstance(reference, str | Path) else as_shape(reference)


def _verify(path: Path, bordered: bool) -> None:
    verify_file(path, bordered)


def _out_of_memory(error: Exception) -> MemoryLimitError:
    return MemoryLimitError(
        f"There is not enough memory ({str(error).splitlines()[0] if str(error) else 'allocation failed'}); "
        f"use fewer points (--max-points) or a coarser mesh (--resolution)."
    )


def _surface(mesh: Mesh, facts: MeshFacts, unsupported: UnsupportedArea, trimming: Trimming | None) -> dict[str, Any]:
    """What the mesh is and what was cut off it, as plain values; an open one has no volume."""
    guarantee = "closed, oriented 2-manifold" if facts.closed else "oriented edge-manifold with borders"
    found = {**facts.as_dict(), **unsupported.as_dict(), "guarantee": guarantee, "quality": quality(mesh).as_dict()}
    if not facts.closed:
        found["volume"] = None
    return {"mesh": found, "trim": None if trimming is None else trimming.as_dict()}


def _report(
    source: Any,
    options: Options,
    stages: Stages,
    counts: IngestCounts,
    solution: Solution,
    misfits: tuple[Misfit, Misfit | None],
    sdf: NeuralSDF,
    surface: dict[str, Any],
    actions: list[str],
    attributes: list[Attribute],
    metrics: Metrics | None,
) -> dict[str, Any]:
    found = {
        "schema_version": SCHEMA_VERSION,
        "command": None,
        "origin": None,
        "input": _named(source),
        "options": options.as_dict(),
        "versions": versions(),
        "ingest": counts.as_dict(),
        "frame": {"center": sdf.frame.center.tolist(), "scale": sdf.frame.scale},
        "fit": {
            "status": solution.status,
            "method": solution.method,
            "interrupted": solution.interrupted,
            "parameters": sdf.parameters,
            "detail": None if sdf.detail is None else sdf.detail.as_dict(sdf.frame.scale),
            "history": [vars(record) for record in solution.history],
            "residuals": misfits[0].as_dict(),
            "held_out": None if misfits[1] is None else misfits[1].as_dict(),
        },
        **surface,
        "actions": actions,
        "attributes": [{"name": one.name, "origin": one.origin} for one in attributes],
        "metrics": None if metrics is None else metrics.as_dict(),
        "stages": stages.as_list(),
        "resources": stages.resources(),
    }
    values: dict[str, Any] = plain(found)
    return values
