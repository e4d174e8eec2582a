"""Clouds written in every format that is read come back unchanged."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scan_writers import FORMS, TURN, file_of, random_cloud

from gnrecon.geometry.colors import as_bytes
from gnrecon.io import READERS, read_cloud

MESHES_ONLY = {".stl", ".3mf"}


def test_every_reader_is_tried() -> None:
    assert {form.suffix.removesuffix(".gz") for form in FORMS.values()} == set(READERS) - MESHES_ONLY - {".conf"}


@pytest.mark.parametrize("name", FORMS)
@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40))
def test_a_cloud_comes_back_unchanged(name: str, seed: int, count: int) -> None:
    cloud = random_cloud(np.random.default_rng(seed), count)
    with tempfile.TemporaryDirectory() as folder:
        back = read_cloud(file_of(name, cloud, Path(folder)))
    np.testing.assert_array_equal(back.points, cloud.points)
    assert cloud.normals is not None
    if "normals" in FORMS[name].holds:
        assert back.normals is not None
        np.testing.assert_allclose(back.normals, cloud.normals, atol=2e-7)
    else:
        assert back.normals is None
    if "colors" in FORMS[name].holds:
        np.testing.assert_array_equal(as_bytes(back.attributes["colors"]), cloud.attributes["colors"])
    if "intensity" in FORMS[name].holds:
        np.testing.assert_array_equal(back.attributes["intensity"], cloud.attributes["intensity"])
    known = (FORMS[name].holds - {"normals"}) | ({"row", "column"} if name == "ptx" else set())
    assert set(back.attributes) == known


@pytest.mark.parametrize("name", ["ptx", "e57"])
def test_posed_scans_tell_where_the_scanner_stood(name: str, rng: np.random.Generator, tmp_path: Path) -> None:
    cloud = read_cloud(file_of(name, random_cloud(rng, 9), tmp_path))
    assert cloud.origins is not None
    np.testing.assert_array_equal(cloud.origins, np.tile(TURN[3, :3], (9, 1)))
