"""The benchmark of batches: its scans are what it says, and its witness sees what is done twice."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import pytest
from benchmarks.__main__ import main as bench
from benchmarks.batch_accidents import BROKEN, CONFIG, BatchWatcher, make_scans
from benchmarks.batch_recovery import sound, table

from gnrecon.batch.job import progress_file, running_folder
from gnrecon.batch.scan_search import ScanSearch, find_scans
from gnrecon.config import read_settings
from gnrecon.io import read_cloud
from gnrecon.runtime.errors import ExitCode, InputError

GOOD = {"exit_code": 8, "meshes": 4, "causes": BROKEN, "twice": [], "same_bytes": True, "seconds": 60.0}
SPEED = {"scans": 4, "ratio": 2.0, "cpu_ratio": 3.0, "overhead_seconds": 0.1}


def test_its_scans_are_good_and_broken(tmp_path: Path) -> None:
    good = make_scans(tmp_path / "scans", 4, points=350, hog_points=1000)
    found = {path.scan.stem: path.scan for path in find_scans([str(tmp_path / "scans")], [], ScanSearch())}
    assert set(found) == {*good, *BROKEN}
    assert {len(read_cloud(found[name])) for name in good} == {350}
    assert len({found[name].read_bytes() for name in good}) == len(good)
    for name in ("torn", "void", "letter"):
        with pytest.raises(InputError):
            read_cloud(found[name])


def test_its_configuration_is_one(tmp_path: Path) -> None:
    (tmp_path / "batch.toml").write_text(CONFIG)
    settings = read_settings(tmp_path / "batch.toml", [], {})
    assert settings.of(Path("torus-00.ply"))["widths"] == (200,)
    assert settings.of(Path("hog.ply"))["read_points"] == 6_000_000
    assert settings.of(Path("hangs.ply"))["timeout"] == "20s"


def test_its_watcher_sees_records_and_brings_accidents(tmp_path: Path) -> None:
    records, folder = tmp_path / ".gnrecon" / "records", running_folder(tmp_path) / "killed-x1"
    records.mkdir(parents=True)
    folder.mkdir(parents=True)
    with BatchWatcher(tmp_path) as watcher:
        victim = subprocess.Popen(["sleep", "60"])
        for name in ("once", "twice"):
            (records / f"{name}.json").touch()
        watcher.look()
        (records / "twice.json").write_text("again")
        watcher.look()
        progress_file(folder).write_text(json.dumps({"pid": victim.pid}))
        assert victim.wait(30) == -signal.SIGSEGV
    assert watcher.finished() == ["once", "twice"]
    assert watcher.twice() == ["twice"]


@pytest.mark.parametrize(
    "fault",
    [{"exit_code": 0}, {"meshes": 3}, {"causes": {**BROKEN, "hog": "signal"}}, {"twice": ["a"]}, {"same_bytes": False}],
)
def test_a_fault_is_seen(fault: dict[str, object]) -> None:
    assert sound(GOOD, 4)
    assert not sound({**GOOD, **fault}, 4)


def test_its_table_has_a_row_a_run() -> None:
    shown = table({"jobs": 2, "runs": {"undisturbed": GOOD, "killed": {**GOOD, "same_bytes": False}}, "speed": SPEED})
    assert shown.row_count == 2
    assert "2.00 times as long" in str(shown.caption)


def test_too_few_scans_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(["batch", "--scans", "7"]) == ExitCode.USAGE
    assert capsys.readouterr().err == "bench: At least 10 scans are needed, not 7.\n"
