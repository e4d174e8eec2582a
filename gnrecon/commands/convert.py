"""``gnrecon convert IN OUT``: any mesh or cloud in another format, unchanged; what is lost on the way is named."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import (
    CLOUD_WRITERS,
    all_members,
    holds,
    read_any,
    unverified,
    writable,
    write_cloud,
    write_mesh,
    written_origin,
)
from gnrecon.io.origin import told
from gnrecon.io.write import losses
from gnrecon.runtime.errors import ExitCode, UsageError
from gnrecon.runtime.files import require_files


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
    require_files(all_members([source]), [target], overwrite)
    extension = target.suffix.lower()
    if extension not in (known := dict.fromkeys([*writable(), *CLOUD_WRITERS])):
        named = ", ".join(suffix[1:] for suffix in known)
        raise UsageError(f"A file cannot be written as {extension or 'one without an extension'!r}; use {named}.")
    found, unread = read_any(source)
    sentences = [f"{source} holds what is not read: {', '.join(unread)}."] if unread else []
    console = Console(stderr=True, quiet=quiet)
    for sentence in [*sentences, *_write(found, target, overwrite), _summary(found, target)]:
        console.print(sentence, highlight=False, markup=False, soft_wrap=True)
    return ExitCode.OK


def _write(found: Mesh | PointCloud, target: Path, overwrite: bool) -> list[str]:
    """Write a mesh or a cloud and return sentences about what was lost."""
    lost: list[str] = []

    def compare(path: Path) -> None:
        lost.extend(losses(found, read_any(path)[0]))

    if isinstance(found, Mesh) and target.suffix.lower() in writable():
        unheld = [name for name, values in found.attributes.items() if not holds(target, name, values)]
        write_mesh(found, target, overwrite, compare)
        origin = written_origin(found, target)
        lost += [] if origin is None else [told(origin)]
        lost += unverified(target)
        lost += [f"The format has no place for {', '.join(unheld)} of the vertices; PLY has."] if unheld else []
    else:
        cloud = PointCloud(found.vertices, found.normals, found.attributes) if isinstance(found, Mesh) else found
        write_cloud(cloud, target, overwrite, compare)
    return lost


def _summary(found: Mesh | PointCloud, target: Path) -> str:
    if isinstance(found, Mesh) and target.suffix.lower() in writable():
        return f"{target}: {len(found.vertices)} vertices, {len(found.faces)} faces."
    return f"{target}: {len(found.vertices if isinstance(found, Mesh) else found.points)} points."
