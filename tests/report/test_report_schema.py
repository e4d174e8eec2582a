"""Every report of a real run follows the published schema, and the schema describes every field of it."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from scan_files import gnrecon, torus, write_scan

import gnrecon as package
from gnrecon.export import MeshFacts, MeshQuality, Metrics, Trimming, UnsupportedArea
from gnrecon.ingest import IngestCounts
from gnrecon.optim import Record
from gnrecon.options import Options
from gnrecon.pipeline import Progress, reconstruct
from gnrecon.report.schema import SCHEMA_VERSION, report_schema

Report = dict[str, Any]

SMALL = {"resolution": 24, "widths": (100,), "max_points": 400}
RUNS: dict[str, dict[str, Any]] = {
    "plain": {"steps": 0},
    "thinned": {"steps": 0, "max_points": None, "fraction": 0.5, "subsample": "voxel", "threads": 1},
    "held out": {"steps": 0, "max_points": None, "spacing": "1.5s", "subsample": "farthest", "holdout": 0.1},
    "cleaned": {
        "steps": 0,
        "smooth_scan": "8s",
        "outliers": "statistical:3",
        "clusters": "on",
        "crop": "-2,-2,-2,2,2,2",
    },
    "shaped": {"widths": None, "max_points": 300, "quality": "draft", "fill": "minimal", "smooth": "strain=1e-4"},
    "gauss-newton": {"steps": 2},
    "line": {"steps": 2, "search": "line", "solver": "qr"},
    "trimmed": {"steps": 0, "trim": "3s", "curvature": True},
    "refined": {"steps": 0, "remesh": 0.4, "simplify": 0.02, "faces": 600, "feature_angle": 40.0},
    "adam": {"steps": 3, "optimiser": "adam"},
    "lbfgs": {"steps": 1, "optimiser": "lbfgs"},
    "deep": {"steps": 3, "widths": (16, 16), "max_points": None},
    "interrupted": {"steps": 50},
    "attributes": {"steps": 0},
    "reference": {"steps": 0},
}


class Interrupting(Progress):
    """Presses Ctrl-C in the second step."""

    def step(self, record: Record, total: int) -> None:
        if record.step == 2 < total == 50:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def cloud() -> tuple[np.ndarray, np.ndarray]:
    return torus(1200, np.random.default_rng(3))


def coloured(points: np.ndarray, normals: np.ndarray) -> package.PointCloud:
    """The same points with a colour and a measured value each."""
    colors = np.full((len(points), 3), 200, dtype=np.uint8)
    return package.PointCloud(points, normals, {"colors": colors, "intensity": points[:, 2]})


@pytest.fixture(scope="module")
def report_of(cloud: tuple[np.ndarray, np.ndarray]) -> Callable[[str], Report]:
    """The report of a run by name; each run is made once."""
    made: dict[str, Report] = {}

    def report(name: str) -> Report:
        if name not in made:
            truth = package.PointCloud(*cloud) if name == "reference" else None
            scan = coloured(*cloud) if name == "attributes" else package.PointCloud(*cloud)
            result = reconstruct(scan, reference=truth, progress=Interrupting(), **(SMALL | RUNS[name]))
            made[name] = json.loads(json.dumps(result.report, allow_nan=False))
        return made[name]

    return report


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(report_schema())


def test_the_schema_is_one() -> None:
    jsonschema.Draft202012Validator.check_schema(report_schema())
    assert report_schema()["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert report_schema()["properties"]["schema_version"]["const"] == SCHEMA_VERSION
    assert package.report_schema() == report_schema()


@pytest.mark.parametrize("name", RUNS)
def test_reports_follow_the_schema(
    name: str, report_of: Callable[[str], Report], validator: jsonschema.Draft202012Validator
) -> None:
    report = report_of(name)
    assert [error.message for error in validator.iter_errors(report)] == []
    assert report["fit"]["interrupted"] == (name == "interrupted")
    assert (report["metrics"] is not None) == (name == "reference")
    carried = [one["name"] for one in report["attributes"]]
    assert ({"colors", "intensity"} <= set(carried)) == (name == "attributes")
    # From a thousand points on, deep fits keep some to check on.
    assert {record["held_out"] is None for record in report["fit"]["history"]} <= {name != "deep"}
    assert len(report["fit"]["history"]) == (2 if name == "interrupted" else RUNS[name].get("steps", 0))


@pytest.mark.parametrize("name", RUNS)
def test_the_numbers_of_a_report_hold(name: str, report_of: Callable[[str], Report]) -> None:
    report = report_of(name)
    resources, stages, ingest = report["resources"], report["stages"], report["ingest"]
    rounding = 0.001 * (len(stages) + 1)
    for key in ("seconds", "cpu_seconds"):
        assert 0 < sum(stage[key] for stage in stages) <= resources[key] + rounding
    # What lies between the stages is bookkeeping; on a busy machine it may have to wait, which takes no processor time.
    assert sum(stage["cpu_seconds"] for stage in stages) > 0.9 * resources["cpu_seconds"]
    assert all(10 < stage["peak_memory_mb"] <= resources["peak_memory_mb"] for stage in stages)
    names = [stage["name"] for stage in stages]
    assert names == [known for known in STAGES if known in names]
    assert ("measure" in names) == (report["metrics"] is not None)
    assert ("refine" in names) == (name == "refined")
    shape = report["mesh"]["quality"]
    assert sum(shape["histogram"]["counts"]) == 3 * report["mesh"]["faces"]
    assert shape["edge_length"]["min"] <= shape["edge_length"]["mean"] <= shape["edge_length"]["max"]
    dropped = ("non_finite", "zero_normals", "duplicates", "repeated", "outliers", "clusters", "held_out", "thinned")
    assert ingest["read"] == ingest["kept"] + sum(ingest[reason] for reason in dropped) == 1200
    if RUNS[name].get("threads"):
        assert resources["threads"] == RUNS[name]["threads"]
    times = [record["seconds"] for record in report["fit"]["history"]]
    assert times == sorted(times)


def test_every_stage_is_explained() -> None:
    explained = DESCRIBED["report.stages[].name"]["description"]
    assert [name for name in STAGES if f"{name}: " not in explained] == []


def objects(schema: dict[str, Any], path: str = "report") -> Iterator[tuple[str, dict[str, Any]]]:
    """All descriptions of objects and values in the schema, with their places."""
    yield path, schema
    for name, inner in schema.get("properties", {}).items():
        yield from objects(inner, f"{path}.{name}")
    if "items" in schema:
        yield from objects(schema["items"], f"{path}[]")


DESCRIBED = dict(objects(report_schema()))
STAGES = DESCRIBED["report.stages[].name"]["enum"]


@pytest.mark.parametrize(("path", "schema"), [*DESCRIBED.items()], ids=[*DESCRIBED])
def test_everything_is_described(path: str, schema: dict[str, Any]) -> None:
    name = path.split(".")[-1]
    if not (path.endswith("[]") and "properties" not in schema):
        assert schema["description"].endswith("."), path
    if "properties" in schema:
        assert schema["additionalProperties"] is False
        assert schema["required"] == list(schema["properties"])
    for ending, unit in (("seconds", "in seconds"), ("_mb", "in MB of 10^6 bytes")):
        assert not name.endswith(ending) or unit in schema["description"]


@pytest.mark.parametrize(
    ("place", "names"),
    [
        ("options", [field.name for field in fields(Options)]),
        ("ingest", [field.name for field in fields(IngestCounts)]),
        ("mesh", [*(field.name for field in [*fields(MeshFacts), *fields(UnsupportedArea)]), "guarantee", "quality"]),
        ("mesh.quality", [field.name for field in fields(MeshQuality)]),
        ("trim", [field.name for field in fields(Trimming)]),
        ("metrics", [*(field.name for field in fields(Metrics)), "relative"]),
        ("fit.history[]", [field.name for field in fields(Record)]),
    ],
)
def test_the_schema_has_the_fields_of_what_it_describes(place: str, names: list[str]) -> None:
    described = DESCRIBED[f"report.{place}"]["properties"]
    assert sorted(described) == sorted(names)


def containers(value: Any) -> Iterator[dict[str, Any]]:
    """All objects within a report."""
    if isinstance(value, dict):
        yield value
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else []:
        yield from containers(inner)


@pytest.mark.parametrize("name", ["gauss-newton", "reference"])
def test_a_field_that_is_new_or_gone_does_not_pass(
    name: str, report_of: Callable[[str], Report], validator: jsonschema.Draft202012Validator
) -> None:
    report = copy.deepcopy(report_of(name))
    for found in containers(report):
        found["brand_new"] = 1
        assert not validator.is_valid(report)
        del found["brand_new"]
        first = next(iter(found))
        value = found.pop(first)
        assert not validator.is_valid(report)
        found[first] = value
    assert validator.is_valid(report)


def test_the_command_line_prints_it_and_its_reports_follow_it(
    tmp_path: Path, cloud: tuple[np.ndarray, np.ndarray], validator: jsonschema.Draft202012Validator
) -> None:
    printed = gnrecon("schema")
    assert (printed.returncode, printed.stderr) == (0, "")
    assert json.loads(printed.stdout) == report_schema()
    scan = write_scan(tmp_path / "ring.ply", *cloud)
    words = ("--report", tmp_path / "report.json", "--widths", "200", "--steps", "0", "--resolution", "24")
    done = gnrecon(scan, "-o", tmp_path / "mesh.obj", *words)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert [error.message for error in validator.iter_errors(report)] == []
    assert f"{report['resources']['seconds']:.1f} s" in done.stderr
