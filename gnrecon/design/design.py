"""A design problem from two files, in unit coordinates.

The frame is that of the design region: its box's centre is the origin and half its longest side is one. Interfaces are
usually in the same coordinates as the region. Where a file has others, as that of the paper's bracket does
(millimetres, while its region is normalised), a frame of its own says how they map: x = (file - origin) / scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnrecon.design.interfaces import Interfaces
from gnrecon.design.region import DesignRegion
from gnrecon.export.boolean import from_solid, to_solid
from gnrecon.export.verify import failures, verify
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.io import read_mesh
from gnrecon.runtime.errors import InputError

MARGIN = 0.1
"""How far the problem's box reaches beyond the design region, in half its longest side."""
_STRAY, _LONGEST = 0.02, 0.1


@dataclass(frozen=True)
class Design:
    """A region to stay within and interfaces to be attached to, both in unit coordinates.

    Parameters
    ----------
    region : DesignRegion
    interfaces : Interfaces
    frame : Frame
        Between the coordinates of the region's file and unit ones.
    """

    region: DesignRegion
    interfaces: Interfaces
    frame: Frame


def read_design(region: str | Path, interfaces: str | Path, interfaces_frame: Frame | None = None) -> Design:
    """Read a design problem.

    Parameters
    ----------
    region : file of a closed mesh: the design region
    interfaces : file of a mesh of open pieces whose faces look out of the part
    interfaces_frame : leads from the interfaces' coordinates (as its file's) to those of the region's file

    Raises
    ------
    InputError
        When a file cannot be read, the region is not closed, or interfaces lie outside of its box.
    """
    envelope, walls = read_mesh(region), read_mesh(interfaces)
    if envelope.volume < 0:
        envelope = Mesh(envelope.vertices, envelope.faces[:, ::-1])
    faults = failures(verify(envelope))
    if faults:
        raise InputError(f"{region}: a design region must be a closed surface, but the mesh {faults[0]}.")
    if interfaces_frame is not None:
        walls = walls.with_vertices(interfaces_frame.to_unit(walls.vertices))
    low, high = envelope.vertices.min(axis=0), envelope.vertices.max(axis=0)
    frame = Frame((low + high) / 2, float((high - low).max()) / 2)
    walls = walls.with_vertices(frame.to_unit(walls.vertices))
    made = DesignRegion(_cut_small(envelope.with_vertices(frame.to_unit(envelope.vertices))), MARGIN)
    _check_place(walls, made, interfaces)
    return Design(made, Interfaces(walls), frame)


def _cut_small(mesh: Mesh) -> Mesh:
    """Return the same surface with no edge longer than `_LONGEST`.

    The needles of which CAD systems make flat faces are too thin for the single precision of the search for the nearest
    point, which would be off by a thousandth.
    """
    return from_solid(to_solid(mesh, merge=False).refine_to_length(_LONGEST), mesh)


def _check_place(walls: Mesh, region: DesignRegion, path: str | Path) -> None:
    beyond = np.maximum(region.mesh.vertices.min(axis=0) - walls.vertices, walls.vertices - region.mesh.vertices.max(0))
    if beyond.max() > _STRAY:
        raise InputError(
            f"{path}: the interfaces reach {beyond.max():.3g} half-lengths of the design region beyond its box; if "
            "their coordinates are others, say which by their frame."
        )
