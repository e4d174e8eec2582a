"""Makes the pictures of the documentation: scan and mesh side by side.

Run it as ``.venv/bin/python scripts/make_pictures.py [NAME ...]``. Scans that are not part of the repository are looked
for in ``--data`` and left out, with a sentence, where they are absent.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import gnrecon

REPOSITORY = Path(__file__).resolve().parents[1]
PICTURES = REPOSITORY / "docs" / "images"
SIZE = (1200, 520)

OWN = {"bracket": (REPOSITORY / "sample_data" / "bracket_dense.ply", (-55.0, 28.0), "z")}
OPEN = {"open_scan": ("real/bunny_scans/bun000.ply", (40.0, 20.0), "y")}
OTHERS = {"anchor": ("srb/anchor.ply", (-50.0, 25.0), "z"), "gargoyle": ("srb/gargoyle.ply", (15.0, 10.0), "y")}


def main() -> int:
    """Draw the named pictures, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*OWN, *OTHERS, *OPEN], help="pictures to make")
    parser.add_argument(
        "--data", type=Path, default=REPOSITORY.parent / "shared" / "data", help="folder of other scans"
    )
    chosen = parser.parse_args()
    others = {name: (chosen.data / path, view, up) for name, (path, view, up) in {**OTHERS, **OPEN}.items()}
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name in chosen.names:
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
