"""What all tests share: quiet threads, seeded chance, and the way to data that is kept outside of the repository."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from pathlib import Path

# Before torch, numpy or open3d is imported, because they read this once: tests must not crowd a shared machine.
os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("OPENBLAS_NUM_THREADS", os.environ["OMP_NUM_THREADS"])
os.environ.setdefault("MKL_NUM_THREADS", os.environ["OMP_NUM_THREADS"])

import hypothesis
import numpy as np
import pytest
from other_packages import acme_scan, install_acme, packages
from scan_files import torus

REPOSITORY = Path(__file__).resolve().parents[1]

# A slow example says more about the machine than about the code.
hypothesis.settings.register_profile("gnrecon", deadline=None)
hypothesis.settings.load_profile("gnrecon")


LONGEST = ("test_docs.py", "test_fit_surface_penalties.py", "test_pipeline.py", "test_notebook.py")
"""Files that take minutes, or long and come last. Each is one process's, which may leave the others without work."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.fixture(scope="session")
def repository() -> Path:
    """The folder that holds setup.cfg."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of test data outside of the repository; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("GNRECON_TEST_DATA", REPOSITORY / "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"there is no test data at {folder} (GNRECON_TEST_DATA names another folder)")
    return folder


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A random generator seeded by the test's name: every test has its own numbers, and the same ones each time.

    A test whose bound holds for most draws but not for all names its seed: ``@pytest.mark.seed(1)``.
    """
    mark = request.node.get_closest_marker("seed")
    return np.random.default_rng(zlib.crc32(request.node.name.encode()) if mark is None else mark.args[0])


@pytest.fixture
def acme_site(tmp_path: Path) -> Iterator[Path]:
    """A folder of installed packages, with one that reads and writes."""
    folder = tmp_path / "site"
    folder.mkdir()
    with packages(folder):
        install_acme(folder)
        yield folder


@pytest.fixture
def acme_ring(tmp_path: Path) -> Path:
    """A scan in a format of that package."""
    return acme_scan(tmp_path / "ring.acme", *torus(1200, np.random.default_rng(3)))
