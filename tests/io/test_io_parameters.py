"""The parameters of reading and writing are frozen, all used, and have the effect that they describe."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from parameter_checks import assert_frozen, read_attributes
from scan_writers import file_of, random_cloud

import gnrecon.io
from gnrecon.io import IOParameters, read_scans
from gnrecon.io.merge import read_chunks
from gnrecon.options import Options


def test_they_are_frozen() -> None:
    assert_frozen(IOParameters())


@pytest.mark.parametrize("name", [field.name for field in fields(IOParameters)])
def test_each_is_used(name: str) -> None:
    assert name in read_attributes(gnrecon.io)


def test_scans_are_thinned_to_the_most_points(tmp_path: Path) -> None:
    path = file_of("ply", random_cloud(np.random.default_rng(2), 300), tmp_path)
    thinned, _ = read_scans([path], parameters=IOParameters(most_points=50))
    assert 5 < len(thinned) <= 50
    np.testing.assert_array_equal(thinned.points, read_scans([path], most=50)[0].points)
    assert Options.of().read_points == IOParameters.most_points
    whole = read_scans([path])[0]
    assert len(whole) == 300
    np.testing.assert_array_equal(whole.points, read_scans([path], parameters=IOParameters())[0].points)


def test_files_are_read_by_chunks(tmp_path: Path) -> None:
    path = file_of("ply", random_cloud(np.random.default_rng(3), 100), tmp_path)

    def sizes(parameters: IOParameters) -> list[int]:
        return [len(chunk.points) for chunk in read_chunks(path, ".ply", parameters=parameters)]

    assert sizes(IOParameters(chunk_points=40)) == [40, 40, 20]
    assert [len(chunk.points) for chunk in read_chunks(path, ".ply")] == sizes(IOParameters()) == [100]
