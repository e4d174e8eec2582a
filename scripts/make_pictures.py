"""Makes the pictures of the documentation: scan and mesh side by side.

Run it as ``.venv/bin/python scripts/make_pictures.py [NAME ...]``. Scans that are not part of the repository are looked
for in ``--data`` and left out, with a sentence, where they are absent.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from holed_can import RADIUS, can, distance
from PIL import Image

import gnrecon

REPOSITORY = Path(__file__).resolve().parents[1]
PICTURES = REPOSITORY / "docs" / "images"
SIZE = (1200, 520)

OWN = {"bracket": (REPOSITORY / "sample_data" / "bracket_dense.ply", (-55.0, 28.0), "z")}
OPEN = {"open_scan": ("real/bunny_scans/bun000.ply", (40.0, 20.0), "y")}
HOLED: dict[str, tuple[dict[str, Any], ...]] = {
    "regularised": ({}, {"fill": "minimal"}, {"prior": "developable"}, {"smooth": "strain=1e-4"})
}
OTHERS = {"anchor": ("srb/anchor.ply", (-50.0, 25.0), "z"), "gargoyle": ("srb/gargoyle.ply", (15.0, 10.0), "y")}


def main() -> int:
    """Draw the named pictures, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*OWN, *HOLED, *OTHERS, *OPEN], help="pictures to make")
    parser.add_argument(
        "--data", type=Path, default=REPOSITORY.parent / "shared" / "data", help="folder of other scans"
    )
    chosen = parser.parse_args()
    others = {name: (chosen.data / path, view, up) for name, (path, view, up) in {**OTHERS, **OPEN}.items()}
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name in chosen.names:
        if name in HOLED:
            draw_holed(PICTURES / f"{name}.png", HOLED[name])
            continue
        scan, view, up = {**OWN, **others}[name]
        if not scan.is_file():
            print(f"{name}: left out, because there is no file {scan}.", file=sys.stderr)
            continue
        cloud = gnrecon.read_cloud(scan)
        if name in OPEN:
            draw_open(cloud, PICTURES / f"{name}.png", view, up)
            continue
        result = gnrecon.reconstruct(cloud)
        gnrecon.render(result.mesh, PICTURES / f"{name}.png", size=SIZE, views=[view], points=cloud, up=up)
        print(PICTURES / f"{name}.png")
    return 0


def draw_holed(path: Path, asked: Sequence[dict[str, Any]]) -> None:
    """Draw a can with a hole as it comes out when other things are asked of its surface, and print their figures."""
    cloud, panel, shown = can(0.12, 0.45), (SIZE[0] // 4, SIZE[1]), []
    for options in asked:
        mesh = gnrecon.reconstruct(cloud, quality="draft", resolution=72, curvature=True, **options).mesh
        shown.append(gnrecon.render(mesh, size=panel, views=[(65.0, 12.0)], up="z"))
        print(options, described(mesh))
    Image.fromarray(np.concatenate(shown, axis=1)).save(path)
    print(path)


def described(mesh: gnrecon.Mesh) -> str:
    """Return how a can is in its hole, and how far from the truth."""
    hole = np.linalg.norm(mesh.vertices - [RADIUS, 0, 0], axis=1) < 0.3
    mean, gauss = (np.asarray(mesh.attributes[f"{name}_curvature"])[hole] for name in ("mean", "gauss"))
    off = np.abs(distance(mesh.vertices))
    return (
        f"in the hole |k1 + k2| {np.median(np.abs(2 * mean)):.2g}, |k1 k2| {np.median(np.abs(gauss)):.2g} in the "
        f"median, {off[hole].mean():.2g} off on the mean and {off[hole].max():.2g} at most; elsewhere "
        f"{off[~hole].mean():.2g} and {off[~hole].max():.2g}"
    )


def draw_open(cloud: gnrecon.PointCloud, path: Path, view: tuple[float, float], up: str) -> None:
    """Draw a scan, its closed surface, and what of that is near data, side by side."""
    result = gnrecon.reconstruct(cloud, max_points=6000, subsample="voxel", steps=0)
    mesh, beyond = result.mesh, result.report["mesh"]["invented_beyond"]
    near, _ = gnrecon.trim(mesh, np.asarray(mesh.attributes["distance"], dtype=np.float64), beyond)
    panel = (SIZE[0] // 3, SIZE[1])
    shown = [gnrecon.render(None, size=panel, views=[view], points=cloud, up=up)]
    shown += [gnrecon.render(part, size=panel, views=[view], up=up) for part in (mesh, near)]
    Image.fromarray(np.concatenate(shown, axis=1)).save(path)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
