"""Damaged scans: seeded mutations of the bytes of valid files, and clouds that are degenerate or hold garbage."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import write_cloud, write_mesh

Float = npt.NDArray[np.float64]

TEXT = (b"nan", b"inf", b"-1", b"0", b"99999999999", b"1e999", b"", b"\n", b" ", b"x", b"4294967295", b'"', b"<", b"{}")
"""Words that replace one of a text file."""

INTEGERS = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80")
"""Integers that replace one of a binary file: the greatest and least, with sign and without."""

GARBAGE = (np.nan, np.inf, -np.inf, 1e38, -3e38, 1e150, 1e300, 1e-160, 1e-310, 0.0)
"""Coordinates that sensors and torn files hold."""


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return damage of the usual kinds: bytes, bits, words, sizes and stretches; changed, cut off or doubled."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        place = int(rng.integers(0, len(data))) if len(data) else 0
        length = int(rng.integers(1, 1 + max(len(data) // 4, 1)))
        match rng.integers(0, 8):
            case 0:
                data[place : place + 1] = bytes([rng.integers(0, 256)])
            case 1 if data:
                data[place] ^= 1 << int(rng.integers(0, 8))
            case 2:
                data[place : place + 4] = rng.choice(INTEGERS)
            case 3:
                del data[place:]
            case 4:
                del data[place : place + length]
            case 5:
                data[place:place] = data[place : place + length]
            case 6:
                words = bytes(data).split(b" ")
                words[int(rng.integers(0, len(words)))] = TEXT[int(rng.integers(0, len(TEXT)))]
                data = bytearray(b" ".join(words))
            case _:
                # Heads hold the counts and sizes that readers trust.
                head = int(rng.integers(0, min(len(data), 400) + 1))
                data[head : head + 1] = bytes([rng.integers(0, 256)])
    return bytes(data)


def odd_cloud(rng: np.random.Generator, *, most_points: int = 400) -> PointCloud:
    """Return a cloud of a sphere or a torus that is whole, few, flat, repeated, scaled, or holds garbage."""
    # Few points take less time, and are odder.
    count = int(rng.integers(1, most_points // int(rng.choice([1, 8, 8]))))
    u, v = rng.uniform(0, 2 * np.pi, (2, count))
    tube = rng.choice([0.0, 0.4])
    normals = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    around = np.column_stack([np.cos(u), np.sin(u), np.zeros(count)])
    points = around + tube * normals if tube else normals.copy()
    some = rng.integers(0, count, max(1, count // 20))
    match rng.integers(0, 8):
        case 0:
            points[some] = rng.choice(GARBAGE, (len(some), 3))
        case 1:
            points[some, rng.integers(0, 3)] = rng.choice(GARBAGE)
        case 2:
            points *= 10.0 ** rng.uniform(-200, 200)
        case 3:
            points[:, rng.integers(0, 3)] = 0.0
        case 4:
            points = points[rng.integers(0, max(1, count // 10), count)]
        case 5:
            normals[some] = rng.choice(GARBAGE, (len(some), 3))
        case 6:
            points += 10.0 ** rng.uniform(0, 12)
        case _:
            pass
    return PointCloud(points, normals if rng.integers(0, 2) else None)


def _mesh(cloud: PointCloud, path: Path) -> None:
    """Write the points as vertices of a mesh, of which no face means anything."""
    count = len(cloud.points)
    rows = np.arange(count)
    points = np.where(np.isfinite(cloud.points), cloud.points, 0.0)  # writers of meshes refuse others
    write_mesh(Mesh(points, np.column_stack([rows, (rows + 1) % count, (rows + 2) % count])), path)


def _las(cloud: PointCloud, path: Path) -> None:
    import laspy

    file = laspy.LasData(laspy.LasHeader(point_format=3, version="1.4"))
    file.header.scales = np.full(3, 1e-4)
    for name, values in zip("xyz", np.clip(np.nan_to_num(cloud.points), -1e5, 1e5).T, strict=True):
        setattr(file, name, values)
    file.write(str(path))


def _open3d(cloud: PointCloud, path: Path) -> None:
    import open3d

    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points))
    if cloud.normals is not None:
        made.normals = open3d.utility.Vector3dVector(cloud.normals)
    open3d.io.write_point_cloud(path, made)


WRITERS: dict[str, Callable[[PointCloud, Path], None]] = {
    **dict.fromkeys((".ply", ".xyz", ".csv"), write_cloud),
    **dict.fromkeys((".obj", ".off", ".stl", ".glb", ".3mf"), _mesh),
    **dict.fromkeys((".las", ".laz"), _las),
    **dict.fromkeys((".pcd", ".pts"), _open3d),
}
"""Writers of a cloud, by extension."""


def damaged_scan(folder: Path, rng: np.random.Generator) -> Path:
    """Write a file that is damaged, odd, or both, and return its path."""
    suffix = str(rng.choice(list(WRITERS)))
    path = folder / f"scan{suffix}"
    try:
        with np.errstate(all="ignore"):
            WRITERS[suffix](odd_cloud(rng), path)
    except Exception:  # a writer need not take an odd cloud; then the file's bytes are the oddity
        path.write_bytes(rng.bytes(200))
    if rng.integers(0, 3):
        path.write_bytes(mutated(path.read_bytes(), rng))
    if rng.integers(0, 8):
        return path
    packed = path.with_name(f"{path.name}.gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()
    return packed
