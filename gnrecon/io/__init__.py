"""Reading clouds and meshes, writing both, and converting other libraries' objects."""

from gnrecon.io.format_registry import CLOUD_WRITERS, READERS, WRITERS, readable, writable
from gnrecon.io.interop import as_cloud, as_mesh, as_shape, to_open3d, to_pymeshlab, to_trimesh
from gnrecon.io.merge import MOST_POINTS, Reading, all_input_files, cropped, read_scans
from gnrecon.io.read import extension_of, read_any, read_cloud, read_mesh, read_reference
from gnrecon.io.write import check_writable, holds, unverified, write_cloud, write_mesh, written_origin
from gnrecon.runtime.files import atomic_write, write_text

__all__ = [
    "CLOUD_WRITERS",
    "MOST_POINTS",
    "READERS",
    "WRITERS",
    "Reading",
    "all_input_files",
    "as_cloud",
    "as_mesh",
    "as_shape",
    "atomic_write",
    "check_writable",
    "cropped",
    "extension_of",
    "holds",
    "read_any",
    "read_cloud",
    "read_mesh",
    "read_reference",
    "read_scans",
    "readable",
    "to_open3d",
    "to_pymeshlab",
    "to_trimesh",
    "unverified",
    "writable",
    "write_cloud",
    "write_mesh",
    "write_text",
    "written_origin",
]
