"""Progress within stages: increasing shares, at no cost, shown as a bar; and cancellation by the caller."""

from __future__ import annotations

import io
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress as Bar
from scan_files import torus, write_scan

from gnrecon.cli.app import main
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.optim import Record
from gnrecon.pipeline import Progress, reconstruct
from gnrecon.report.schema import report_schema
from gnrecon.report.time_left import TimeLeft
from gnrecon.run import STAGES, ConsoleProgress
from gnrecon.runtime.errors import Cancelled, ExitCode
from gnrecon.runtime.progress import subrange

SMALL: dict[str, Any] = {"widths": (100,), "steps": 2, "resolution": 32}
SMALLEST = ("--widths", "80", "--steps", "0", "--resolution", "24")

Cloud = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    return torus(1200, np.random.default_rng(3))


class Ledger(Progress):
    """Records the shares of each stage, and cancels the run at a given call."""

    def __init__(self, method: str = "", stage: str = "") -> None:
        self.shares: dict[str, list[float]] = {}
        self._method, self._stage = method, stage

    def _heard(self, method: str) -> None:
        if method == self._method and [*self.shares][-1] == self._stage:
            raise Cancelled

    def stage(self, name: str) -> None:
        self.shares[name] = []
        self._heard("stage")

    def advance(self, share: float) -> None:
        self.shares[[*self.shares][-1]].append(share)
        self._heard("advance")

    def step(self, record: Record, total: int) -> None:
        del record, total
        self._heard("step")

    def remark(self, sentence: str) -> None:
        del sentence
        self._heard("remark")


@pytest.fixture(scope="module")
def ledger(cloud: Cloud) -> Ledger:
    told = Ledger()
    reconstruct(*cloud, reference=PointCloud(*cloud), progress=told, **SMALL)
    return told


def test_shares_only_grow_from_nothing_to_all(ledger: Ledger) -> None:
    for stage, shares in ledger.shares.items():
        assert shares == sorted(shares), stage
        assert all(0 <= share <= 1 for share in shares), stage
    for stage in ("fit", "extract", "project", "measure"):
        assert ledger.shares[stage][-1] == pytest.approx(1), stage
    # Three rounds of the start, and two steps.
    assert len(ledger.shares["fit"]) == 5


def test_nothing_is_told_so_often_that_it_costs(ledger: Ledger) -> None:
    # An update of a bar takes about ten microseconds, and the smallest run half a second.
    assert sum(map(len, ledger.shares.values())) < 200


def test_a_deep_fit_tells_of_its_start_and_of_each_step(cloud: Cloud) -> None:
    told = Ledger("stage", "extract")
    with pytest.raises(Cancelled):
        reconstruct(*cloud, progress=told, widths=(12, 12), steps=3)
    shares = told.shares["fit"]
    assert len(shares) == 4
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1)


@pytest.mark.parametrize(
    ("method", "stage"),
    [
        ("stage", "read"),
        ("advance", "read"),
        ("advance", "ingest"),
        ("advance", "fit"),
        ("step", "fit"),
        ("remark", "fit"),
        ("advance", "extract"),
        ("advance", "project"),
        ("stage", "verify"),
    ],
)
def test_any_call_may_end_the_run(cloud: Cloud, method: str, stage: str) -> None:
    told = Ledger(method, stage)
    with pytest.raises(Cancelled, match=r"^Cancelled; nothing was written\.$"):
        reconstruct(*cloud, progress=told, max_points=300, **SMALL)
    assert [*told.shares][-1] == stage


EVERY_STAGE = [
    "read",
    "ingest",
    "fit",
    "extract",
    "project",
    "refine",
    "repair",
    "trim",
    "verify",
    "attributes",
    "measure",
]


@pytest.mark.parametrize("stage", EVERY_STAGE)
def test_a_run_may_end_at_every_stage(cloud: Cloud, stage: str) -> None:
    told = Ledger("stage", stage)
    few: dict[str, Any] = {"widths": (80,), "steps": 0, "resolution": 24, "max_points": 300}
    with pytest.raises(Cancelled):
        reconstruct(*cloud, reference=PointCloud(*cloud), progress=told, simplify=0.05, trim="20s", **few)
    assert [*told.shares] == EVERY_STAGE[: EVERY_STAGE.index(stage) + 1]


def test_a_command_that_ends_before_it_writes_leaves_nothing(
    tmp_path: Path, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnrecon.run.ConsoleProgress.stage", lambda _, name: cancel() if name == "write" else None)
    scan = write_scan(tmp_path / "ring.ply", *cloud)
    handler = signal.getsignal(signal.SIGTERM)
    asked = [str(tmp_path / name) for name in ("mesh.obj", "report.json", "model.gnr")]
    with pytest.raises(SystemExit) as end:
        main([str(scan), "-o", asked[0], "--report", asked[1], "--save", asked[2], *SMALLEST])
    signal.signal(signal.SIGTERM, handler)
    assert end.value.code == ExitCode.INTERRUPTED
    assert [path.name for path in tmp_path.iterdir()] == ["ring.ply"]


def test_a_part_tells_of_the_whole() -> None:
    told: list[float] = []
    inner = subrange(subrange(told.append, 0.5, 1.0), 0.0, 0.5)
    for share in (0.0, 0.5, 1.0):
        inner(share)
    assert told == [0.5, 0.625, 0.75]


def test_the_bar_shows_the_share_of_the_stage() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120)
    with Bar(console=console, auto_refresh=False) as bar:
        shown = ConsoleProgress(console, bar, verbose=False, left=TimeLeft())
        shown.stage("fit")
        assert bar.tasks[0].total is None
        shown.advance(0.25)
        shown.step(Record(1, 2.0, 1.0, 1e-3, 0.9, 1.0), 4)
        assert bar.tasks[0].percentage == 25
        assert "loss 1.000e+00" in bar.tasks[0].fields["detail"]
        shown.stage("extract")
        assert [task.description for task in bar.tasks] == ["Extracting"]
        assert bar.tasks[0].total is None


def test_every_stage_has_its_words() -> None:
    stage = report_schema()["properties"]["stages"]["items"]["properties"]["name"]
    # Writing comes after the report, and saved fields are meshed without one.
    assert [name for name in STAGES if name in stage["enum"]] == stage["enum"]


def cancel() -> None:
    raise Cancelled


def test_a_cancelled_command_ends_as_an_interrupted_one(
    tmp_path: Path, cloud: Cloud, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gnrecon.run.ConsoleProgress.advance", lambda *_: cancel())
    scan = write_scan(tmp_path / "ring.ply", *cloud)
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        main([str(scan), "-o", str(tmp_path / "mesh.obj"), "--report", str(tmp_path / "report.json")])
    signal.signal(signal.SIGTERM, handler)
    assert end.value.code == ExitCode.INTERRUPTED
    assert capfd.readouterr().err == "gnrecon: Cancelled; nothing was written.\n"
    assert [path.name for path in tmp_path.iterdir()] == ["ring.ply"]
