"""``gnrecon eval MESH --reference FILE``: how far a mesh lies from the surface that it should be."""

from __future__ import annotations

import json
from pathlib import Path

from gnrecon.export import measure
from gnrecon.io import all_members, read_mesh, read_reference
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import require_files, write_text


def evaluate(
    path: Path, reference: Path, *, samples: int, seed: int, report: Path | None = None, overwrite: bool = False
) -> int:
    """Print the distances between a mesh and a reference with their definitions, and return the exit code 0.

    Parameters
    ----------
    path : the mesh
    reference : a mesh or a cloud in the same frame and units
    samples : points on each surface
    seed : of the sampling
    report : JSON file to write with all figures
    overwrite : whether an existing report may be replaced

    Raises
    ------
    UsageError
        When the number of samples is not positive, or the report is one of the inputs.
    InputError
        When a file cannot be read, or holds nothing to measure.
    OutputError
        When the report cannot be written.
    """
    require_files(all_members([path, reference]), [] if report is None else [report], overwrite)
    metrics = measure(read_mesh(path), read_reference(reference), samples=samples, seed=seed)
    if report is not None:
        figures = {"mesh": str(path), "reference": str(reference), "seed": seed, **metrics.as_dict()}
        write_text(report, json.dumps(figures, indent=2) + "\n", overwrite)
    print("\n".join(metrics.describe()))
    return ExitCode.OK
