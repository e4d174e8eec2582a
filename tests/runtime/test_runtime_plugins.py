"""Plugins of other packages are found, used and checked; broken ones give one sentence."""

from __future__ import annotations

import gzip
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from other_packages import ACME, install, packages
from scan_files import torus

from gnrecon.fit import FitOptions, fit
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.io import read_cloud, read_mesh, write_mesh
from gnrecon.pipeline import reconstruct
from gnrecon.residuals import SecondOrder, eikonal, interface, mean_curvature, named
from gnrecon.runtime.errors import FitError, GnreconError, InputError, OutputError, UsageError

TETRA = Mesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.mark.usefixtures("acme_site")
def test_a_reader_is_found_and_its_cloud_comes_back(acme_ring: Path) -> None:
    assert "acme" not in sys.modules
    points, normals = torus(1200, np.random.default_rng(3))
    for path in (acme_ring, acme_ring.with_suffix(".acme.gz")):
        path.write_bytes(gzip.compress(acme_ring.read_bytes()) if path.suffix == ".gz" else acme_ring.read_bytes())
        cloud = read_cloud(path)
        np.testing.assert_array_equal(cloud.points, points)
        np.testing.assert_array_equal(cloud.normals, normals)
        np.testing.assert_array_equal(cloud.attributes["heat"], points[:, 2])
    acme_ring.rename(acme_ring.with_suffix(".bin"))
    assert len(read_cloud(acme_ring.with_suffix(".bin"), format="acme")) == 1200


@pytest.mark.usefixtures("acme_site")
def test_a_scan_of_another_package_is_reconstructed_as_any_other(acme_ring: Path) -> None:
    few = {"widths": (200,), "steps": 0, "resolution": 24}
    found = reconstruct(acme_ring, **few)
    plain = reconstruct(*torus(1200, np.random.default_rng(3)), **few)
    np.testing.assert_array_equal(found.mesh.vertices, plain.mesh.vertices)
    assert "heat" in found.mesh.attributes
    path = acme_ring.with_name("mesh.acmesh")
    assert found.save(path) == []
    np.testing.assert_array_equal(read_mesh(path).vertices, found.mesh.vertices)


@pytest.mark.usefixtures("acme_site")
def test_what_is_built_in_stays(tmp_path: Path) -> None:
    write_mesh(TETRA, tmp_path / "ball.ply")
    assert len(read_mesh(tmp_path / "ball.ply").faces) == len(TETRA.faces)
    assert "acme" not in sys.modules


BROKEN_READERS = {
    "missing": ("", "cannot be loaded (AttributeError: ", UsageError),
    "import": ("import no_such_library", "cannot be loaded (ModuleNotFoundError: No module named ", UsageError),
    "exit": ("raise SystemExit(0)", "cannot be loaded (SystemExit: 0)", UsageError),
    "value": ("read = 3", "is 'int', which cannot be called", UsageError),
    "raises": ("def read(path):\n    raise ValueError('bad\\nheader')", "failed (ValueError: bad header)", InputError),
    "exits": ("def read(path):\n    raise SystemExit(0)", "failed (SystemExit: 0)", InputError),
    "nothing": (
        "def read(path):\n    return None",
        "returned something that is not a cloud: Expected points",
        InputError,
    ),
    "text": (
        "def read(path):\n    return 'points'",
        "returned something that is not a cloud: Expected points",
        InputError,
    ),
    "flat": ("def read(path):\n    return [[1, 2], [3, 4]]", "points of shape (N, 3) or (N, 6)", InputError),
    "empty": (
        "def read(path):\n    return [[0, 0, 0]][:0] or __import__('numpy').zeros((0, 3))",
        "no points",
        InputError,
    ),
    "heat": (
        "from gnrecon import PointCloud\ndef read(path):\n    return PointCloud([[0, 0, 1]], attributes={'a': ['x']})",
        "returned the attribute 'a' of type <U1 and shape (1,), but numbers",
        InputError,
    ),
    "face": (
        "from gnrecon import Mesh\ndef read(path):\n    return Mesh([[0, 0, 1]], [[0, 0, 7]])",
        "A face names a vertex outside",
        InputError,
    ),
    "gone": ("def read(path):\n    open(path / 'no')", "the file cannot be read: Not a directory", InputError),
}


@pytest.mark.parametrize("name", BROKEN_READERS)
def test_a_broken_reader_is_one_sentence(tmp_path: Path, name: str) -> None:
    code, sentence, kind = BROKEN_READERS[name]
    scan = tmp_path / "scan.bad"
    scan.write_text("1 2 3\n")
    (tmp_path / "site").mkdir()
    install(tmp_path / "site", "badly", code, readers={"bad": "read"})
    with packages(tmp_path / "site"), pytest.raises(GnreconError) as caught:
        read_cloud(scan)
    assert type(caught.value) is kind
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


BROKEN_WRITERS = {
    "import": ("import no_such_library", UsageError, "The writer 'bad' of the package badly 1.2 cannot be loaded ("),
    "raises": ("def write(mesh, path):\n    raise KeyError('x')", OutputError, "badly 1.2 failed (KeyError: 'x')."),
    "idle": (
        "def write(mesh, path):\n    pass",
        OutputError,
        "The writer 'bad' of the package badly 1.2 wrote nothing.",
    ),
    "spoils": ("def write(mesh, path):\n    mesh.vertices[:] = 0", OutputError, "wrote nothing"),
    "full": ("def write(mesh, path):\n    raise OSError(28, 'Disk full')", OutputError, "written: Disk full"),
}


@pytest.mark.parametrize("name", BROKEN_WRITERS)
def test_a_broken_writer_leaves_no_file(tmp_path: Path, name: str) -> None:
    code, kind, sentence = BROKEN_WRITERS[name]
    (tmp_path / "site").mkdir()
    install(tmp_path / "site", "badly", code, writers={"bad": "write"})
    mesh = replace(TETRA, vertices=TETRA.vertices.copy())
    with packages(tmp_path / "site"), pytest.raises(GnreconError) as caught:
        write_mesh(mesh, tmp_path / "mesh.bad")
    assert type(caught.value) is kind
    assert sentence in str(caught.value)
    np.testing.assert_array_equal(mesh.vertices, TETRA.vertices)
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


def test_several_packages_for_one_name_are_refused(acme_site: Path, acme_ring: Path) -> None:
    install(acme_site, "rival", ACME, readers={"acme": "read"}, residuals={"thin": "read"})
    with pytest.raises(UsageError, match=r"offer a reader 'acme': the package (acme|rival) 1.2 and the package (r|a)"):
        read_cloud(acme_ring)


@pytest.mark.usefixtures("acme_site")
def test_what_is_installed_is_named_where_nothing_fits(tmp_path: Path) -> None:
    (tmp_path / "scan.docx").write_text("0 0 0\n")
    with pytest.raises(InputError, match=r"'.docx' is not supported; expected one of ply.*, conf, acme, acmesh, lossy"):
        read_cloud(tmp_path / "scan.docx")
    with pytest.raises(UsageError, match=r"'.docx'; use obj, .*, 3mf, acme-only, acmesh, lossy"):
        write_mesh(TETRA, tmp_path / "mesh.docx")


RESIDUALS = """
from gnrecon.residuals import Linearised, mean_curvature, normal_cosine, from_formula

def tilted(value, gradient, target):
    return normal_cosine(value, gradient, target)

def short(value, gradient, target):
    return Linearised(value[1:, None], None, None)

def narrow(value, gradient, target):
    return Linearised(value[:, None], None, gradient)

def number(value, gradient, target):
    return 0.0

def fails(value, gradient, target):
    raise ZeroDivisionError("by zero")

bend = from_formula("bend", lambda f, g, H: (H.trace() + 0.0 * f + 0.0 * g.sum())[None])
"""
NAMES = ("tilted", "short", "narrow", "number", "fails", "bend")


@pytest.fixture
def residuals(tmp_path: Path) -> Iterator[None]:
    with packages(tmp_path):
        install(tmp_path, "bends", RESIDUALS, residuals={name: name for name in NAMES})
        yield


@pytest.mark.usefixtures("residuals")
def test_residuals_are_found_by_name() -> None:
    assert (named("eikonal"), named("interface")) == (eikonal, interface)
    assert named("mean_curvature") is mean_curvature
    value, gradient = torch.ones(4), torch.rand(4, 3, generator=torch.Generator().manual_seed(0))
    hessian = torch.eye(3).expand(4, 3, 3)
    bend = named("bend")
    assert isinstance(bend, SecondOrder)
    assert bend(value, gradient, hessian).residual.tolist() == [[3.0]] * 4
    with pytest.raises(UsageError, match=r"no residual 'bent'; there are interface, .*, bend, fails"):
        named("bent")


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("short", "returned residuals of shape (3, 1), but (4, m) was expected"),
        ("narrow", "returned by_gradient of shape (4, 3), but (4, 1, 3) was expected"),
        ("number", "returned float, but must return Linearised"),
        ("fails", "failed (ZeroDivisionError: by zero)"),
    ],
)
@pytest.mark.usefixtures("residuals")
def test_what_a_residual_returns_is_checked(name: str, sentence: str) -> None:
    residual = named(name)
    assert not isinstance(residual, SecondOrder)
    with pytest.raises(FitError) as caught:
        residual(torch.ones(4), torch.ones(4, 3), None)
    assert str(caught.value) == f"The residual {name!r} of the package bends 1.2 {sentence}."


@pytest.mark.usefixtures("residuals")
def test_normals_may_have_a_residual_of_another_package() -> None:
    points, normals = torus(400, np.random.default_rng(1))
    samples = Samples(points, normals, Frame(np.zeros(3), 1.0))
    ours, theirs = (
        fit(samples, FitOptions(widths=(60,), steps=2, normals=name))[0].theta for name in ("cosine", "tilted")
    )
    assert torch.equal(ours, theirs)
    with pytest.raises(UsageError, match=r"one of vector, projection, cosine, bend, fails, .*, tilted, not 'cross'"):
        FitOptions(normals="cross")
    with pytest.raises(UsageError, match="'bend' needs second derivatives"):
        FitOptions(normals="bend")
    with pytest.raises(FitError, match="failed"):
        fit(samples, FitOptions(widths=(60,), steps=2, normals="fails"))
