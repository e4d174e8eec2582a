"""The commands on files: ``gnrecon check``, ``eval`` and ``convert``."""

from __future__ import annotations

import json
import math
from pathlib import Path

from rich.console import Console

from gnrecon.cli.conversion_losses import round_trip_losses
from gnrecon.export import examine, measure
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import (
    CLOUD_WRITERS,
    all_input_files,
    read_any,
    read_mesh,
    read_reference,
    supports_attribute,
    unverified_remark,
    writable,
    write_cloud,
    write_mesh,
    written_origin,
)
from gnrecon.io.formats.stl import origin_remark
from gnrecon.runtime.errors import ExitCode, MeshError, UsageError
from gnrecon.runtime.files import one_line, require_files, write_text
from gnrecon.runtime.interrupts import ignore_interrupts


def check(path: Path, *, as_json: bool = False) -> int:
    """Print the findings on a mesh, as text or as one JSON object, and return the exit code 0 where it bounds a solid.

    Raises
    ------
    InputError
        When the file cannot be read or holds no faces.
    MeshError
        When the mesh does not bound a solid, after printing; the sentence names everything that is wrong.
    """
    findings = examine(read_mesh(path))
    if as_json:
        # JSON has no numbers that are not finite, such as the volume of a mesh with broken vertices.
        values = {name: _plain(value) for name, value in findings.as_dict().items()}
        print(json.dumps({"file": str(path), **values}, indent=2))
    else:
        print("\n".join(findings.describe()))
    if not findings.sound:
        raise MeshError(f"{path} does not bound a solid: it {'; it '.join(findings.failures)}.")
    return ExitCode.OK


def _plain(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
    require_files(all_input_files([path, reference]), [] if report is None else [report], overwrite)
    metrics = measure(read_mesh(path), read_reference(reference), samples=samples, seed=seed)
    if report is not None:
        figures = {"mesh": str(path), "reference": str(reference), "seed": seed, **metrics.as_dict()}
        ignore_interrupts()
        write_text(report, json.dumps(figures, indent=2) + "\n", overwrite)
    print("\n".join(metrics.describe()))
    return ExitCode.OK


def convert(source: Path, target: Path, *, overwrite: bool = False, quiet: bool = False) -> int:
    """Write what a file holds in the format that the target's extension names, and return the exit code 0.

    Nothing is repaired: a mesh that is open stays open. The file is read back and compared before it gets its name.

    Raises
    ------
    UsageError
        When the extension is unknown, a cloud is to become a mesh, or the target is the source.
    InputError
        When the source cannot be read.
    MeshError, OutputError
        When the target cannot be written.
    """
    require_files(all_input_files([source]), [target], overwrite)
    extension = target.suffix.lower()
    if extension not in (known := dict.fromkeys([*writable(), *CLOUD_WRITERS])):
        named = ", ".join(suffix[1:] for suffix in known)
        raise UsageError(f"A file cannot be written as {extension or 'one without an extension'!r}; use {named}.")
    found, unread = read_any(source)
    sentences = [f"{source} holds what is not read: {', '.join(unread)}."] if unread else []
    console = Console(stderr=True, quiet=quiet)
    for sentence in [*sentences, *_write(found, target, overwrite), _summary(found, target)]:
        console.print(one_line(sentence), highlight=False, markup=False, soft_wrap=True)
    return ExitCode.OK


def _write(found: Mesh | PointCloud, target: Path, overwrite: bool) -> list[str]:
    """Write a mesh or a cloud and return sentences about what was lost."""
    lost: list[str] = []

    def compare(path: Path) -> None:
        lost.extend(round_trip_losses(found, read_any(path)[0]))
        ignore_interrupts()

    if isinstance(found, Mesh) and target.suffix.lower() in writable():
        unheld = [name for name, values in found.attributes.items() if not supports_attribute(target, name, values)]
        write_mesh(found, target, overwrite, compare)
        origin = written_origin(found, target)
        lost += [] if origin is None else [origin_remark(origin)]
        lost += unverified_remark(target)
        lost += [f"The format has no place for {', '.join(unheld)} of the vertices; PLY has."] if unheld else []
    else:
        cloud = PointCloud(found.vertices, found.normals, found.attributes) if isinstance(found, Mesh) else found
        write_cloud(cloud, target, overwrite, compare)
    return lost


def _summary(found: Mesh | PointCloud, target: Path) -> str:
    if isinstance(found, Mesh) and target.suffix.lower() in writable():
        return f"{target}: {len(found.vertices)} vertices, {len(found.faces)} faces."
    return f"{target}: {len(found.vertices if isinstance(found, Mesh) else found.points)} points."
