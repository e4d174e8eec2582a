"""Reads and writes point clouds and meshes, and converts objects of other libraries."""

from gnrecon.io.column_names import parse_columns
from gnrecon.io.format_registry import CLOUD_WRITERS, READERS, WRITERS, readable, writable
from gnrecon.io.interop import as_cloud, as_mesh, as_shape, to_meshio, to_open3d, to_pymeshlab, to_pyvista, to_trimesh
from gnrecon.io.io_parameters import IOParameters
from gnrecon.io.merge import Reading, cropped, read_scans
from gnrecon.io.named_files import all_input_files
from gnrecon.io.read import extension_of, read_any, read_cloud, read_mesh, read_reference
from gnrecon.io.write import (
    check_writable,
    supports_attribute,
    unverified_remark,
    write_cloud,
    write_mesh,
    written_origin,
)

__all__ = [
    "CLOUD_WRITERS",
    "READERS",
    "WRITERS",
    "IOParameters",
    "Reading",
    "all_input_files",
    "as_cloud",
    "as_mesh",
    "as_shape",
    "check_writable",
    "cropped",
    "extension_of",
    "parse_columns",
    "read_any",
    "read_cloud",
    "read_mesh",
    "read_reference",
    "read_scans",
    "readable",
    "supports_attribute",
    "to_meshio",
    "to_open3d",
    "to_pymeshlab",
    "to_pyvista",
    "to_trimesh",
    "unverified_remark",
    "writable",
    "write_cloud",
    "write_mesh",
    "written_origin",
]
