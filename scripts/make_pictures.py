"""Makes the pictures of the documentation: scan and mesh side by side; scripts/make_first_screen.py makes the README's.

Run it as ``.venv/bin/python scripts/make_pictures.py [NAME ...]``. Scans that are not part of the
repository are taken from ``--data``; those that are missing are skipped with a message.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from holed_can import Can
from PIL import Image

import gnrecon

REPOSITORY = Path(__file__).resolve().parents[1]
OPEN = {"open_scan": ("real/bunny_scans/bun000.ply", (40.0, 20.0), "y")}
HOLED: dict[str, tuple[dict[str, Any], ...]] = {
    "regularised": ({}, {"fill": "minimal"}, {"prior": "developable"}, {"smooth": "strain=1e-4"})
}
OTHERS = {"anchor": ("srb/anchor.ply", (-50.0, 25.0), "z"), "gargoyle": ("srb/gargoyle.ply", (15.0, 10.0), "y")}


def main() -> int:
    """Draw the named pictures, by default all."""
    folder, size = REPOSITORY / "docs" / "images", (1200, 520)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*HOLED, *OTHERS, *OPEN], help="pictures to make")
    parser.add_argument(
        "--data", type=Path, default=REPOSITORY.parent / "shared" / "data", help="folder of other scans"
    )
    chosen = parser.parse_args()
    others = {name: (chosen.data / path, view, up) for name, (path, view, up) in {**OTHERS, **OPEN}.items()}
    folder.mkdir(parents=True, exist_ok=True)
    for name in chosen.names:
        if name in HOLED:
            draw_holed(folder / f"{name}.png", HOLED[name], size)
            continue
        scan, view, up = others[name]
        if not scan.is_file():
            print(f"{name}: skipped, because there is no file {scan}.", file=sys.stderr)
            continue
        cloud = gnrecon.read_cloud(scan)
        if name in OPEN:
            draw_open(cloud, folder / f"{name}.png", view, up, size)
            continue
        result = gnrecon.reconstruct(cloud)
        gnrecon.render(result.mesh, folder / f"{name}.png", size=size, views=[view], points=cloud, up=up)
        print(folder / f"{name}.png")
    return 0


def draw_holed(path: Path, choices: Sequence[dict[str, Any]], size: tuple[int, int]) -> None:
    """Draw the reconstructions of a can with a hole with different options, and print their figures."""
    cloud, panel, shown = Can().scan(0.12, 0.45), (size[0] // 4, size[1]), []
    for options in choices:
        mesh = gnrecon.reconstruct(cloud, quality="draft", resolution=72, curvature=True, **options).mesh
        shown.append(gnrecon.render(mesh, size=panel, views=[(65.0, 12.0)], up="z"))
        print(options, described(mesh))
    Image.fromarray(np.concatenate(shown, axis=1)).save(path)
    print(path)


def described(mesh: gnrecon.Mesh) -> str:
    """Return the curvatures in the hole of a can, and the distances from the truth."""
    hole = Can().in_hole(mesh.vertices, 0.3)
    mean, gauss = (np.asarray(mesh.attributes[f"{name}_curvature"])[hole] for name in ("mean", "gauss"))
    off = np.abs(Can().distance(mesh.vertices))
    return (
        f"in the hole |k1 + k2| {np.median(np.abs(2 * mean)):.2g}, |k1 k2| {np.median(np.abs(gauss)):.2g} in the "
        f"median, {off[hole].mean():.2g} off on the mean and {off[hole].max():.2g} at most; elsewhere "
        f"{off[~hole].mean():.2g} and {off[~hole].max():.2g}"
    )


def draw_open(cloud: gnrecon.PointCloud, path: Path, view: tuple[float, float], up: str, size: tuple[int, int]) -> None:
    """Draw a scan, its closed surface, and the part of the surface near data, side by side."""
    result = gnrecon.reconstruct(cloud, max_points=6000, subsample="voxel", steps=0)
    mesh, beyond = result.mesh, result.report["mesh"]["invented_beyond"]
    near, _ = gnrecon.trim(mesh, np.asarray(mesh.attributes["distance"], dtype=np.float64), beyond)
    panel = (size[0] // 3, size[1])
    shown = [gnrecon.render(None, size=panel, views=[view], points=cloud, up=up)]
    shown += [gnrecon.render(part, size=panel, views=[view], up=up) for part in (mesh, near)]
    Image.fromarray(np.concatenate(shown, axis=1)).save(path)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
