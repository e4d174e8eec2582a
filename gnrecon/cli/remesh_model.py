"""Meshes a saved field for ``gnrecon mesh``: finer, cropped, offset or hollow, without refitting."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from gnrecon.export import Neighbourhood, require_sound, verify_file
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import check_writable, readable, supports_attribute, write_mesh
from gnrecon.options import Options
from gnrecon.report.report import Stages
from gnrecon.run import progress_bar, summarise
from gnrecon.runtime.compute_limits import limited, require_device
from gnrecon.runtime.errors import ExitCode, InputError
from gnrecon.runtime.files import one_line, require_files
from gnrecon.runtime.interrupts import ignore_interrupts
from gnrecon.solid import Shape, shaped
from gnrecon.vertex_attributes import curvature_attributes, requested_names


def remesh_model(
    model: Path, output: Path, options: dict[str, Any], shape: Shape, *, overwrite: bool = False, quiet: bool = False
) -> int:
    """Mesh a saved field, write the mesh once it is verified, and return the exit code 0.

    Parameters
    ----------
    model : a file that `NeuralSDF.save` wrote
    output : the mesh; its extension names the format
    options : of the meshing, by their names in `Options`; the field is evaluated on the device
    shape : offset, shell and crop, in file units
    overwrite : whether an existing mesh may be replaced
    quiet : print failures only

    Raises
    ------
    UsageError, InputError, MeshError, OutputError, MemoryLimitError
        Each says in one sentence what is wrong; nothing is written then.
    """
    check_writable(output)
    require_files([model], [output], overwrite)
    chosen = Options.of(**options)
    require_device(chosen.device)
    requested_names(PointCloud(np.empty((0, 3))), chosen.attributes)  # a misspelt name is refused before the work
    console = Console(stderr=True, quiet=quiet)
    with progress_bar(console, verbose=False) as progress, limited(chosen.threads):
        stages = Stages(progress.stage, chosen.device)
        with stages("read"):
            sdf = _load(model, chosen.device)
        mesh, remarks = shaped(sdf, chosen, shape, stages=stages, advance=progress.advance)
        with stages("verify"):
            facts = require_sound(mesh)
        if shape.levels == (0.0,):  # distances and curvatures are those of the zero level
            with stages("attributes"):
                mesh = _with_attributes(mesh, sdf, chosen, output)
        progress.stage("write")
        losses = write_mesh(mesh, output, overwrite, verify=_verify)
    summary = summarise(output, facts.as_dict(), stages.resources())
    for sentence in [*remarks, *losses, summary]:
        console.print(one_line(sentence), highlight=False, markup=False, soft_wrap=True)
    return ExitCode.OK


def _load(model: Path, device: str) -> NeuralSDF:
    """Load a field; the name of a mesh or a scan says which commands take that."""
    try:
        return NeuralSDF.load(model, device)
    except InputError:
        if Path(model.name.removesuffix(".gz")).suffix.lower() not in readable():
            raise
        raise InputError(
            f"{model} is not a gnrecon model (.gnr): gnrecon check and gnrecon eval take meshes, and gnrecon SCAN -o "
            "MESH takes a scan."
        ) from None


def _with_attributes(mesh: Mesh, sdf: NeuralSDF, options: Options, output: Path) -> Mesh:
    """Return a mesh with distances to the model's points and with curvatures, as the options request.

    With ``auto``, distances are left out where the format cannot hold them.
    """
    made = {one.name: one.values for one in (curvature_attributes(mesh, sdf) if options.curvature else [])}
    if options.attributes != "none" and sdf.data is not None:
        distances = Neighbourhood(sdf.data).distances(mesh.vertices)
        if options.attributes != "auto" or supports_attribute(output, "distance", distances):
            made["distance"] = distances
    return mesh.with_attributes(made)


def _verify(path: Path) -> None:
    verify_file(path)
    ignore_interrupts()
