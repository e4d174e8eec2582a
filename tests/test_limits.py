"""Numbers that no machine can serve are refused before the work."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gnrecon.batch.job import JobOutcome, Status
from gnrecon.batch.summary import summary_csv
from gnrecon.cli.learn_problem import LearnOptions
from gnrecon.config import read_settings
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.smooth import smooth_points
from gnrecon.ingest.subsample import subsample
from gnrecon.options import Options
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.runtime.files import printable
from gnrecon.runtime.typed_values import parse_megabytes


@pytest.mark.parametrize(
    "values",
    [
        {"threads": 2000},
        {"widths": (1_000_000_000,)},
        {"widths": (2,) * 65},
        {"resolution": 10**30},
        {"seed": 10**5000},
        {"faces": 10**30},
        {"read_points": 10**30},
        {"steps": 10**30},
        {"max_error": 1e-300},
        {"edge_length": 1e300},
        {"remesh": 1e-200},
        {"edge_length": 10**5000},
        {"units": 10**5000},
        {"spacing": 1e-300},
        {"spacing": "1e300s"},
        {"smooth_scan": "1e300"},
        {"trim": "1e-200"},
    ],
)
def test_absurd_values(values: dict[str, Any]) -> None:
    with pytest.raises(UsageError) as error:
        Options(**values)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    ("name", "value"),
    [("threads", 2000), ("seed", 10**40), ("seed", -1), ("resolution", 10**6), ("steps", 10**30), ("wider", 10**6)],
)
def test_absurd_values_for_learning(name: str, value: int) -> None:
    with pytest.raises(UsageError, match=r"must (be at most|not be negative)"):
        LearnOptions(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("number", ["9" * 5000, "0x" + "f" * 20_000])
@pytest.mark.parametrize("name", ["seed", "edge_length", "widths", "memory"])
def test_numbers_of_thousands_of_digits(tmp_path: Path, name: str, number: str) -> None:
    """Python neither reads nor prints them."""
    config = tmp_path / "options.toml"
    config.write_text(f"{name} = {number}\n")
    for path, words in ((config, ()), (None, (f"{name}={number}",))):
        with pytest.raises((UsageError, InputError)) as error:
            require_valid(read_settings(path, words, {}).of(Path("scan.ply")))
        assert "\n" not in str(error.value)


def require_valid(values: dict[str, Any]) -> None:
    parse_megabytes(values.pop("memory", "1GB"))
    Options(**values)


def test_long_and_short_reaches_are_not_squared_beyond_the_doubles() -> None:
    cloud = np.random.default_rng(0).standard_normal((100, 3))
    normals = cloud / np.linalg.norm(cloud, axis=1, keepdims=True)
    assert len(subsample(PointCloud(cloud), spacing=1e-200)) == 100
    moved, _ = smooth_points(cloud, normals, 1e200)
    assert np.isfinite(moved).all()


@pytest.mark.parametrize("values", [{"remesh": 1e-9}, {"max_error": 1e-12}, {"simplify": 1e-30}])
def test_lengths_too_short_for_the_scan(values: dict[str, Any]) -> None:
    options = Options(**values)
    options.require_reachable(np.array([[0.0] * 3, [1e-30 if "simplify" in values else 1e-6] * 3]))
    with pytest.raises(UsageError, match="give --"):
        options.require_reachable(np.array([[0.0] * 3, [100.0] * 3]))


def test_names_are_no_formulas_and_need_not_be_text() -> None:
    lines = summary_csv([JobOutcome("=1+1", "-scan.ply", Status.FAILED)]).splitlines()
    assert lines[1].startswith("'=1+1,'-scan.ply,")
    assert printable("a\udcff.ply") == "a\\udcff.ply"
    odd = ["\rb\r.ply", 'c\r\n",d.ply']
    table = summary_csv([JobOutcome("a", name, Status.FAILED) for name in odd])
    rows = list(csv.DictReader(io.StringIO(table, newline="")))
    assert [row["scan"] for row in rows] == [f"'{odd[0]}", odd[1]]
