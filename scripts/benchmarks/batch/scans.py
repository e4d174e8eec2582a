"""Small scans of tori, and six that come to grief, each in another way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

BROKEN = {
    "torn": "input",
    "void": "input",
    "letter": "input",
    "killed": "signal",
    "hangs": "timeout",
    "hog": "memory",
}
"""Names of the broken scans, and the cause that each is to be told by."""

POINTS, HOG_POINTS = 400, 6_000_000
MEMORY = "1500MB"

CONFIG = f"""widths = [200]
steps = 0
resolution = 32
timeout = "1h"
memory = "{MEMORY}"

[scans."hangs.*"]
timeout = "20s"

[scans."hog.*"]
read-points = {HOG_POINTS}
"""
"""Configuration of the batch: fast fits, and limits."""


def make_scans(folder: Path, good: int) -> list[str]:
    """Fill a new folder with good scans and the broken ones; return the names of the good ones."""
    folder.mkdir()
    names = [f"torus-{number:02d}" for number in range(good)]
    for number, name in enumerate(names):
        rng = np.random.default_rng(number)
        write_ply(folder / f"{name}.ply", *torus(POINTS, 0.25 + 0.2 * rng.random(), rng))
    whole = (folder / f"{names[0]}.ply").read_bytes()
    (folder / "torn.ply").write_bytes(whole[: len(whole) // 2])
    (folder / "void.ply").touch()
    (folder / "letter.txt").write_text("Dear reader,\nthis is a letter.\n", encoding="utf-8")
    for name in ("killed", "hangs"):
        (folder / f"{name}.ply").write_bytes(whole)
    write_ply(folder / "hog.ply", *torus(HOG_POINTS, 0.3, np.random.default_rng(0)))
    return names


def torus(count: int, tube: float, rng: np.random.Generator) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Points and normals, each of shape (count, 3), on a torus of radius 1."""
    u, v = rng.uniform(0, 2 * np.pi, (2, count)).astype(np.float32)
    normals = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    return np.column_stack([np.cos(u), np.sin(u), np.zeros_like(u)]) + np.float32(tube) * normals, normals


def write_ply(path: Path, points: npt.NDArray[np.float32], normals: npt.NDArray[np.float32]) -> None:
    """Write a binary PLY of points with normals."""
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + np.hstack([points, normals]).astype("<f4").tobytes())
