"""A small run for the page's tests: a torus with everything that a page can show."""

from __future__ import annotations

import base64
import json
import re
import zlib
from html.parser import HTMLParser
from typing import Any

import numpy as np

from gnrecon.export import measure, verify
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.geometry.statistics import Histogram

CENTRE = np.array([500_000.0, 4_500_000.0, 100.0])
"""Far from the origin, as projected coordinates are."""


def torus(around: int = 48, tube: int = 24, scale: float = 10.0) -> Mesh:
    """A closed torus about the axis z, with exact normals, of radius 1 and tube 0.4 times `scale`."""
    u, v = np.meshgrid(np.arange(around), np.arange(tube), indexing="ij")
    a, b = 2 * np.pi * u.ravel() / around, 2 * np.pi * v.ravel() / tube
    normals = np.column_stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
    vertices = CENTRE + scale * (np.column_stack([np.cos(a), np.sin(a), 0 * a]) + 0.4 * normals)

    def index(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return ((i % around) * tube + j % tube).ravel()

    corners = index(u, v), index(u + 1, v), index(u + 1, v + 1), index(u, v + 1)
    faces = np.concatenate([np.column_stack([corners[k] for k in pick]) for pick in ((0, 1, 2), (0, 2, 3))])
    return Mesh(vertices, faces, normals)


def adorned(mesh: Mesh) -> Mesh:
    """The mesh with all that gnrecon may find of its vertices, and something of the scan's own."""
    x, y, z = ((mesh.vertices - CENTRE) / 10).T
    return mesh.with_attributes(
        {
            "error": 0.05 * np.sin(5 * x),
            "sigma": 0.01 + 0.02 * z**2,
            "distance": np.hypot(x, y) / 5,
            "mean_curvature": -0.2 + 0.1 * y,
            "gauss_curvature": 0.05 * x * y,
            "colors": np.uint8(np.clip(127 + 90 * np.column_stack([x, y, z]), 0, 255)),
            "intensity": np.float32(1 + y),
        }
    )


def scan(mesh: Mesh) -> PointCloud:
    """Coloured points at the vertices."""
    return PointCloud(mesh.vertices, mesh.normals, {"colors": adorned(mesh).attributes["colors"]})


def report(mesh: Mesh) -> dict[str, Any]:
    """A report with every part."""
    residual = {"mean": 0.01, "rms": 0.02, "median": 0.005, "p95": 0.03, "max": 0.1}
    spread = Histogram.of(np.linspace(-1, 1, 50), -0.9, 0.9, 20).as_dict()
    values = {
        "command": "gnrecon 'a scan.ply' -o mesh.ply --html page.html",
        "input": "folder/a scan.ply",
        "options": {"fraction": None, "widths": [300], "resolution": 48, "seed": 0},
        "versions": {"gnrecon": "1.2.3", "python": "3.11", "torch": "2.4"},
        "ingest": {
            "read": 1300, "non_finite": 3, "zero_normals": 0, "duplicates": 0, "outliers": 97, "outliers_found": 0,
            "thinned": 0, "kept": 1200, "normals": "given",
        },
        "fit": {
            "status": "Stopped at the limit of 3 steps.",
            "method": "Gauss-Newton.",
            "interrupted": False,
            "history": [
                {"step": i, "before": 2.0 ** (1 - i), "loss": 2.0**-i, "damping": 10.0**-i, "held_out": 3.0**-i,
                 "seconds": 1.5 * i}
                for i in (1, 2, 3)
            ],
            "residuals": {
                "points": 1200,
                "distance": {**residual, "histogram": spread},
                "angle": {**residual, "histogram": spread},
            },
        },
        "mesh": {
            **verify(mesh).as_dict(), "invented_area_share": 0.125, "invented_beyond": 0.22,
            "guarantee": "closed, oriented 2-manifold",
        },
        "trim": None,
        "fineness": {"resolution": 256, "edge_length": 0.5, "chord_error": 0.0125},
        "actions": ["Dropped 2 of 3 components."],
        "attributes": [{"name": "intensity", "origin": "weighted mean of the nearest points"}],
        "metrics": measure(mesh, mesh, samples=500).as_dict(),
        "stages": [{"name": "fit", "seconds": 75.0, "peak_memory_mb": 1200.0},
                   {"name": "verify", "seconds": 0.5, "peak_memory_mb": 900.0}],
        "resources": {"seconds": 76.0, "peak_memory_mb": 1200.0, "device": "cpu", "device_name": None, "threads": 2},
    }  # fmt: skip
    made: dict[str, Any] = json.loads(json.dumps(values))
    return made


class Elements(HTMLParser):
    """Every element of a page with its attributes, and the text that a reader sees."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._inside: list[str] = []
        self.feed(text)
        self.text = re.sub(r"\s+", " ", self.text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        while self._inside and self._inside.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if not {"script", "style"} & set(self._inside):
            self.text += data + " "


def buffer(text: str, name: str, kind: str) -> np.ndarray:
    """An array that a page carries."""
    found = re.search(rf'id="buffer-{re.escape(name)}">([^<]*)<', text)
    assert found, name
    return np.frombuffer(zlib.decompress(base64.b64decode(found[1])), dtype=kind)


def scene(text: str) -> dict[str, Any]:
    """What a page says of its model."""
    found = re.search(r'id="scene">(.*?)</script>', text)
    assert found
    return dict(json.loads(found[1]))
