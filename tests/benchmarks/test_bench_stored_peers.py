"""Stored figures of peers: read, checked for unit and points, shown beside the others, and counted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.__main__ import main as bench
from benchmarks.accuracy.cases import GROUPS, cases_of, stored_name
from benchmarks.accuracy.problem import Problem
from benchmarks.accuracy.stored_peers import StoredName, StoredStanding, best_stored, read_stored, stored_standing
from benchmarks.accuracy.summary import accuracy_table, summarise
from printed_tables import printed

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import InputError


def row(peer: str = "one", mean: float = 2.0, hausdorff: float = 50.0, **more: Any) -> dict[str, Any]:
    """A line of the file."""
    head = {"case": "group/shape", "points": 4, "peer": peer, "setting": "d8", "cd": mean, "hd": hausdorff}
    return head | {"acc": mean - 0.5, "comp": mean + 0.5, "cpu": 1.25} | more


def written(path: Path, *rows: Mapping[str, Any]) -> Path:
    path.write_text("".join(json.dumps(line) + "\n" for line in rows), encoding="utf-8")
    return path


def problem(radius: float | None = 1.0, count: int = 4) -> Problem:
    """A tetrahedron of radius one."""
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    scan = PointCloud(np.resize(corners, (count, 3)))
    return Problem(scan, Mesh(corners, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])), radius=radius)


NAME = StoredName("group/shape")


def test_the_least_mean_comes_first_and_then_the_least_hausdorff_distance(tmp_path: Path) -> None:
    lines = [row("one", 3.0, 70.0), row("two", 2.0, 60.0), row("three", 4.0, 20.0, cpu=None), row(case="other")]
    stored = read_stored(written(tmp_path / "peers.jsonl", *lines))
    first, second = best_stored(NAME, problem(), stored)
    assert (first["method"], second["method"]) == ("two", "three")
    # In the truth's unit, which is its radius.
    found = [first[key] for key in ("chamfer_mean", "mesh_to_reference_mean", "reference_to_mesh_mean", "hausdorff")]
    assert found == pytest.approx([2e-3, 1.5e-3, 2.5e-3, 60e-3])
    assert (first["cpu_seconds"], second["cpu_seconds"]) == (1.25, None)
    assert len(best_stored(StoredName("other"), problem(), stored)) == 1
    assert best_stored(None, problem(), stored) == best_stored(StoredName("unknown"), problem(), stored) == []


def test_figures_in_another_unit_or_of_other_points_are_refused(tmp_path: Path) -> None:
    stored = read_stored(written(tmp_path / "peers.jsonl", row()))
    own = StoredName("group/shape", own_unit=True)
    assert best_stored(own, problem(radius=None), stored)[0]["chamfer_mean"] == 2.0
    for name, given in ((own, problem()), (NAME, problem(radius=None))):
        with pytest.raises(InputError, match="are not in"):
            best_stored(name, given, stored)
    with pytest.raises(InputError, match="relative to 1, not to 2"):
        best_stored(NAME, problem(radius=2.0), stored)
    with pytest.raises(InputError, match="has 5 points, but one had 4"):
        best_stored(NAME, problem(count=5), stored)
    assert not best_stored(StoredName("group/shape", same_points=False), problem(count=5), stored)[0]["same_points"]


def test_a_broken_file_is_refused_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_stored(tmp_path / "nothing.jsonl")
    incomplete = {key: value for key, value in row().items() if key != "hd"}
    for broken in (incomplete, row(cd="far"), row(cd=None)):
        path = written(tmp_path / "peers.jsonl", row(), broken)
        with pytest.raises(InputError, match="line 2, is no line of stored figures"):
            read_stored(path)
    assert bench(["accuracy", "--cases", "sphere", "--peers", str(tmp_path / "nothing.jsonl")]) == 3
    shown = capsys.readouterr()
    assert (shown.out, len(shown.err.splitlines())) == ("", 1)


def trial(method: str, mean: float, hausdorff: float) -> dict[str, Any]:
    head = {"case": "shape", "method": method, "settings": {}, "seed": 0, "points": 4, "folder": "x"}
    ways = {f"{way}_{kind}": mean for way in ("reference_to_mesh", "mesh_to_reference") for kind in ("mean", "rms")}
    return head | ways | {"chamfer_mean": mean, "hausdorff": hausdorff, "cpu_seconds": 3.5}


def test_stored_peers_are_rows_of_the_table(tmp_path: Path) -> None:
    stored = read_stored(written(tmp_path / "peers.jsonl", row("one", 2.0, 50.0), row("two", 3.0, 40.0, cpu=None)))
    found = summarise([trial("gnrecon", 1e-3, 0.03)], problem(), best_stored(NAME, problem(), stored))
    found["stored"][1]["same_points"] = False
    lines = printed(accuracy_table([found], 1)).replace("│", " ").splitlines()
    ours, one, two = (next(line for line in lines if name in line).split() for name in ("gnrecon", "one,", "two,"))
    assert ours[1:6] == ["1.000", "1.000", "1.000", "1.000", "30.0"]
    assert one == ["stored", "one,", "d8", "2.500", "1.500", "2.000", "-", "50.0", *["-"] * 6, "1.2", "-"]
    assert two[:5] == ["stored", "two,", "d8", "(other", "points)"]
    assert two[9:] == ["40.0", *["-"] * 8]


def compared(ours: tuple[float, float] | None, best: tuple[float, float], same_points: bool = True) -> dict[str, Any]:
    """A summary with the mean and the Hausdorff distance of gnrecon, None where it failed, and of a stored peer."""
    own = {"error": "No."} if ours is None else {"chamfer_mean": ours[0], "hausdorff": ours[1]}
    stored = {"chamfer_mean": best[0], "hausdorff": best[1], "same_points": same_points}
    return {"methods": {"gnrecon": own}, "stored": [stored]}


def test_the_standing_counts_means_and_hausdorff_distances() -> None:
    cases = [
        compared((0.8, 10.0), (1.0, 10.0)),
        compared((0.9, 10.9), (1.0, 10.0)),
        compared((1.5, 11.5), (1.0, 10.0)),
        compared(None, (1.0, 10.0)),
        compared((0.1, 1.0), (1.0, 10.0), same_points=False),
        {"methods": {"gnrecon": {"chamfer_mean": 1.0, "hausdorff": 1.0}}, "stored": []},
        {"methods": {"Poisson": {}}, "stored": compared(None, (1.0, 1.0))["stored"]},
    ]
    place = stored_standing(cases)
    assert place == StoredStanding(cases=4, below=2, clearly=1, near=2, margin=0.15, ratio=1.1)
    assert "Of 4 cases" in place.describe()
    assert "in 2, by 15 % or more in 1; its Hausdorff distance is at most 1.1 times" in place.describe()
    assert stored_standing(cases[4:]) is None


def test_names_are_of_one_case_each() -> None:
    names = [name.name for case in cases_of(GROUPS).values() if (name := stored_name(case)) is not None]
    assert len(set(names)) == len(names) == 28
    assert all(stored_name(case) is None for case in GROUPS["analytic"].values())


def test_the_stored_figures_fit_the_cases(shared_data: Path) -> None:
    path = shared_data.parent / "baselines" / "peers.jsonl"
    if not path.is_file():
        pytest.skip(f"there are no stored figures at {path}")
    stored = read_stored(path)
    fitting = [
        best_stored(name, case.problem(shared_data, 0), stored)
        for case in cases_of(GROUPS).values()
        if (name := stored_name(case)) is not None
    ]
    assert len(fitting) == len(stored)
    assert all(fitting)
