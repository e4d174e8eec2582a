"""One code for every device: a GPU gives the surface that the CPU gives, and reads nothing that lies elsewhere."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from made_shapes import box, sphere, torus
from scipy.spatial import cKDTree

from gnrecon.export import verify
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.pipeline import Reconstruction, reconstruct

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=NEEDS_GPU)]

SCANS = {
    "torus": lambda: torus(1500, 3, 1.0, 0.3),
    "noisy ball": lambda: sphere(1500, 1, noise=0.01),
    "box": lambda: box(2000, np.random.default_rng(2), (1.0, 0.7, 0.5)),
    "torus without normals": lambda: (torus(1500, 4, 1.0, 0.3)[0], None),
    "one network": lambda: torus(1500, 3, 1.0, 0.3),
}
OPTIONS: dict[str, dict[str, object]] = {"one network": {"widths": (24, 24), "steps": 15}}


@cache
def reconstructed(name: str, device: str) -> Reconstruction:
    """Return a scan's reconstruction on a device, as the default or with the scan's own options."""
    points, normals = SCANS[name]()
    return reconstruct(points, normals, device=device, resolution=64, threads=2, **OPTIONS.get(name, {}))


def distance(one: Float, other: Float) -> float:
    """Return the largest distance of the vertices of one from those of another."""
    return float(cKDTree(other).query(one)[0].max())


@NEEDS_GPU
@pytest.mark.parametrize("name", SCANS)
def test_a_gpu_gives_the_surface_that_the_cpu_gives(name: str) -> None:
    here, there = reconstructed(name, "cpu"), reconstructed(name, "cuda")
    assert there.report["resources"]["device_name"] == torch.cuda.get_device_name()
    assert there.report["resources"]["cuda_peak_memory_mb"] > 0
    assert verify(there.mesh).genus == verify(here.mesh).genus
    # Sums differ in their last digits, and each decision that they turn moves the surface by a part of its error.
    cell = 2 * 1.3 / 64
    assert distance(here.mesh.vertices, there.mesh.vertices) < cell
    assert there.mesh.volume == pytest.approx(here.mesh.volume, rel=2e-3)


@pytest.mark.parametrize("device", DEVICES)
def test_a_field_is_on_its_device_and_gives_arrays(device: str, tmp_path: Path) -> None:
    field = reconstructed("torus", device).sdf
    assert isinstance(field, NeuralSDF)
    assert field.theta.device.type == device
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))
    value, gradient = field.sdf_and_gradient(x)
    hessian = field.hessian(x)
    assert (value.shape, gradient.shape, hessian.shape) == ((500,), (500, 3), (500, 3, 3))
    np.testing.assert_allclose(field.sdf(x), value, atol=1e-5)
    field.save(tmp_path / "field.gnr")
    again = NeuralSDF.load(tmp_path / "field.gnr", device=device)
    assert again.theta.device.type == device
    np.testing.assert_allclose(again.sdf(x), value, atol=1e-5)
    np.testing.assert_allclose(NeuralSDF.load(tmp_path / "field.gnr").sdf(x), value, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_what_else_a_run_can_be_asked_for_works_on_it(device: str) -> None:
    points, normals = SCANS["torus"]()
    result = reconstruct(points, normals, device=device, resolution=48, uncertainty=True)
    assert result.uncertainty is not None
    assert (result.uncertainty.sigma(result.mesh.vertices[:100]) > 0).all()
