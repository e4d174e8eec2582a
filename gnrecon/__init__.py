"""Watertight meshes from point clouds by neural signed distance fields.

By default, Gauss-Newton fits a sine network as the smooth global field, unless a linear field of sine features predicts
the scan as well, and linear least squares add local fields. `reconstruct` with ``widths`` fits one network alone.

>>> import gnrecon
>>> result = gnrecon.reconstruct("scan.ply")        # doctest: +SKIP
>>> result.save("mesh.obj")                         # doctest: +SKIP

The names below are imported on first use, so that ``import gnrecon`` is fast.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

from gnrecon import deprecated_paths
from gnrecon.runtime.errors import Cancelled, FitError, GnreconError, InputError, MeshError, OutputError, UsageError
from gnrecon.version import __version__

if TYPE_CHECKING:
    from gnrecon.export import (
        examine,
        extract,
        measure,
        project,
        remove_handles,
        remove_stray,
        repair,
        require_sound,
        trim,
        verify,
    )
    from gnrecon.fit import FitOptions, NeuralSDF, Uncertainty, fit
    from gnrecon.geometry.mesh import Mesh
    from gnrecon.geometry.point_cloud import Frame, PointCloud, Samples
    from gnrecon.ingest import prepare, survey
    from gnrecon.io import (
        as_cloud,
        as_mesh,
        read_cloud,
        read_mesh,
        readable,
        to_meshio,
        to_open3d,
        to_pymeshlab,
        to_pyvista,
        to_trimesh,
        writable,
        write_cloud,
        write_mesh,
    )
    from gnrecon.options import Options
    from gnrecon.pipeline import Progress, Reconstruction, reconstruct
    from gnrecon.rendering import render
    from gnrecon.report.html import write_page
    from gnrecon.report.schema import report_schema
    from gnrecon.solid import Shape, shaped

_ROOMS = {
    "gnrecon.export": (
        "examine",
        "extract",
        "measure",
        "project",
        "remove_handles",
        "remove_stray",
        "repair",
        "require_sound",
        "trim",
        "verify",
    ),
    "gnrecon.fit": ("FitOptions", "NeuralSDF", "Uncertainty", "fit"),
    "gnrecon.geometry.mesh": ("Mesh",),
    "gnrecon.geometry.point_cloud": ("Frame", "PointCloud", "Samples"),
    "gnrecon.ingest": ("prepare", "survey"),
    "gnrecon.io": (
        "as_cloud",
        "as_mesh",
        "read_cloud",
        "read_mesh",
        "readable",
        "to_meshio",
        "to_open3d",
        "to_pymeshlab",
        "to_pyvista",
        "to_trimesh",
        "writable",
        "write_cloud",
        "write_mesh",
    ),
    "gnrecon.options": ("Options",),
    "gnrecon.rendering": ("render",),
    "gnrecon.report.html": ("write_page",),
    "gnrecon.pipeline": ("Progress", "Reconstruction", "reconstruct"),
    "gnrecon.report.schema": ("report_schema",),
    "gnrecon.solid": ("Shape", "shaped"),
}

__all__ = [
    "Cancelled",
    "FitError",
    "FitOptions",
    "Frame",
    "GnreconError",
    "InputError",
    "Mesh",
    "MeshError",
    "NeuralSDF",
    "Options",
    "OutputError",
    "PointCloud",
    "Progress",
    "Reconstruction",
    "Samples",
    "Shape",
    "Uncertainty",
    "UsageError",
    "__version__",
    "as_cloud",
    "as_mesh",
    "examine",
    "extract",
    "fit",
    "measure",
    "prepare",
    "project",
    "read_cloud",
    "read_mesh",
    "readable",
    "reconstruct",
    "remove_handles",
    "remove_stray",
    "render",
    "repair",
    "report_schema",
    "require_sound",
    "shaped",
    "survey",
    "to_meshio",
    "to_open3d",
    "to_pymeshlab",
    "to_pyvista",
    "to_trimesh",
    "trim",
    "verify",
    "writable",
    "write_cloud",
    "write_mesh",
    "write_page",
]


# A library is silent unless the program that uses it asks for its log.
logging.getLogger(__name__).addHandler(logging.NullHandler())

deprecated_paths.install()


def __getattr__(name: str) -> Any:
    if f"{__name__}.{name}" in deprecated_paths.MOVED:
        return import_module(f"{__name__}.{name}")
    room = next((room for room, names in _ROOMS.items() if name in names), None)
    if room is None:
        raise AttributeError(f"module 'gnrecon' has no attribute {name!r}")
    value = getattr(import_module(room), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, so that completion offers these and nothing else."""
    return sorted(__all__)
