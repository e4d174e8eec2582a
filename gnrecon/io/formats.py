"""The table of file formats: to add one, write a module beside this and a line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gnrecon.io.contents import Contents
from gnrecon.io.glb import read_glb, write_glb
from gnrecon.io.obj import read_obj, write_obj
from gnrecon.io.off import read_off, write_off
from gnrecon.io.pcd import read_pcd
from gnrecon.io.ply import read_ply, write_ply
from gnrecon.io.stl import read_stl, write_stl
from gnrecon.io.xyz import read_xyz
from gnrecon.mesh import Mesh

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
}

WRITERS: dict[str, Callable[[Mesh, Path], None]] = {
    ".obj": write_obj,
    ".ply": write_ply,
    ".stl": write_stl,
    ".off": write_off,
    ".glb": write_glb,
}

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
    b"\x1f\x8b": "gzip archive",
    b"LASF": "LAS or LAZ",
    b"ASTM-E57": "E57",
}
