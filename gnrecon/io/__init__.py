"""Reading clouds and meshes, writing meshes, and converting other libraries' objects."""

from gnrecon.atomic import atomic_write, write_text
from gnrecon.io.formats import READERS, WRITERS
from gnrecon.io.objects import as_cloud, to_open3d, to_trimesh
from gnrecon.io.read import read_cloud, read_mesh, read_reference
from gnrecon.io.write import check_writable, holds, write_mesh

__all__ = [
    "READERS",
    "WRITERS",
    "as_cloud",
    "atomic_write",
    "check_writable",
    "holds",
    "read_cloud",
    "read_mesh",
    "read_reference",
    "to_open3d",
    "to_trimesh",
    "write_mesh",
    "write_text",
]
