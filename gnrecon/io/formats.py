"""The table of file formats: to add one, write a module beside this and a line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gnrecon.geometry.arrays import Values
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.conf import read_conf
from gnrecon.io.contents import Contents
from gnrecon.io.e57 import read_e57
from gnrecon.io.glb import fits_glb, read_glb, write_glb
from gnrecon.io.gltf import read_gltf
from gnrecon.io.las import read_las
from gnrecon.io.obj import read_obj, write_obj
from gnrecon.io.off import read_off, write_off
from gnrecon.io.pcd import read_pcd
from gnrecon.io.ply import read_ply, write_ply
from gnrecon.io.ptx import read_ptx
from gnrecon.io.stl import read_stl, write_stl
from gnrecon.io.threemf import write_3mf
from gnrecon.io.threemf_model import read_3mf
from gnrecon.io.vtk import read_vtk
from gnrecon.io.vtp import read_vtp
from gnrecon.io.xyz import read_xyz, write_xyz

READERS: dict[str, Callable[[Path], Contents]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".xyz": read_xyz,
    ".pts": read_xyz,
    ".txt": read_xyz,
    ".csv": read_xyz,
    ".obj": read_obj,
    ".off": read_off,
    ".stl": read_stl,
    ".glb": read_glb,
    ".gltf": read_gltf,
    ".3mf": read_3mf,
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
    ".ptx": read_ptx,
    ".vtk": read_vtk,
    ".vtp": read_vtp,
    ".conf": read_conf,
}

WRITERS: dict[str, Callable[[Mesh, Path], None]] = {
    ".obj": write_obj,
    ".ply": write_ply,
    ".stl": write_stl,
    ".off": write_off,
    ".glb": write_glb,
    ".3mf": write_3mf,
}

CLOUD_WRITERS: dict[str, Callable[[Mesh, Path], None]] = {
    ".ply": write_ply,
    ".xyz": write_xyz,
    ".txt": write_xyz,
    ".csv": write_xyz,
}
"""Writers of vertices without faces."""


def _color(name: str, values: Values) -> bool:
    del values
    return name == "colors"


def _number(name: str, values: Values) -> bool:
    del name
    return values.dtype.kind in "biuf"


def _nothing(name: str, values: Values) -> bool:
    del name, values
    return False


HOLDS: dict[str, Callable[[str, Values], bool]] = {
    ".obj": _color,
    ".ply": _number,
    ".stl": _nothing,
    ".off": _color,
    ".glb": fits_glb,
    ".3mf": _color,
}
"""Which attributes of vertices a format can hold, by name and values."""

ZIPPED = (".3mf",)
"""Formats that are ZIP archives of their parts."""

SAME_BEGINNING = ({".las", ".laz"},)
"""Formats that begin alike and have one reader."""

# How files begin, to name what a wrongly named file really is.
SIGNATURES: dict[bytes, str] = {
    b"ply\n": ".ply",
    b"ply\r": ".ply",
    b"# .PCD": ".pcd",
    b"VERSION .7": ".pcd",
    b"VERSION 0.7": ".pcd",
    b"OFF": ".off",
    b"COFF": ".off",
    b"NOFF": ".off",
    b"glTF": ".glb",
    b"\x89PNG": "PNG image",
    b"\xff\xd8\xff": "JPEG image",
    b"%PDF": "PDF document",
    b"PK\x03\x04": "ZIP archive",
    b"LASF": ".las",
    b"ASTM-E57": ".e57",
    b"# vtk DataFile": ".vtk",
}
