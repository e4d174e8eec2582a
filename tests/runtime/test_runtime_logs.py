"""Log records of the library and their display by the command line; without either there is no output."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scan_files import torus, write_scan

from gnrecon.cli.app import main
from gnrecon.pipeline import Progress, reconstruct
from gnrecon.runtime.errors import Cancelled, ExitCode

FEW: dict[str, Any] = {"widths": (150,), "steps": 1, "resolution": 24}
WORDS = ("--widths", "150", "--steps", "1", "--resolution", "24")
STAGES = ["read", "ingest", "fit", "extract", "project", "repair", "verify", "attributes"]


@pytest.fixture(scope="module")
def cloud() -> tuple[np.ndarray, np.ndarray]:
    return torus(600, np.random.default_rng(3))


@pytest.fixture
def scan(tmp_path: Path, cloud: tuple[np.ndarray, np.ndarray]) -> Path:
    return write_scan(tmp_path / "ring.ply", *cloud)


def run(*words: object) -> int:
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    signal.signal(signal.SIGTERM, handler)
    return int(end.value.code or 0)


def test_the_library_says_nothing_by_itself() -> None:
    script = (
        "import logging, gnrecon\nlogging.getLogger('gnrecon.fit').error('loud')\nprint(logging.getLogger().handlers)"
    )
    repository = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=repository, check=True)
    assert (done.stdout, done.stderr) == ("[]\n", "")


class Told(Progress):
    """Keeps the remarks."""

    def __init__(self) -> None:
        self.remarks: list[str] = []

    def remark(self, sentence: str) -> None:
        self.remarks.append(sentence)


def test_stages_choices_steps_and_remarks_are_logged(
    cloud: tuple[np.ndarray, np.ndarray], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "gnrecon")
    told = Told()
    reconstruct(*cloud, progress=told, **FEW)
    said = [record.getMessage() for record in caplog.records]
    assert [line.split()[1] for line in said if line.endswith("begins.")] == STAGES
    assert [line.split()[1].rstrip(":") for line in said if line.endswith("MB at most.")] == STAGES
    assert sum(line.startswith("Step 1 of at most 1: Record(step=1") for line in said) == 1
    assert any(line.startswith("Kept 600 of 600 points") for line in said)
    assert any(line.startswith("Extracted ") and line.endswith("with 24 cells.") for line in said)
    assert [record.getMessage() for record in caplog.records if getattr(record, "already_shown", False)] == told.remarks
    assert {record.name.partition(".")[0] for record in caplog.records} == {"gnrecon"}


def test_a_log_is_appended_to_and_ends_with_the_failure(
    scan: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log, mesh = tmp_path / "run.log", tmp_path / "mesh.obj"
    assert run(scan, "-o", mesh, "--log", log, *WORDS, "-q") == ExitCode.OK
    first = log.read_text()
    assert capfd.readouterr().err == ""
    assert all(line[:4].isdigit() and " gnrecon." in line for line in first.splitlines())
    for words in (f"Read 600 points of {scan} as .ply.", "Stage fit: ", f"faces to {mesh}."):
        assert words in first
    (tmp_path / "bad.xyz").write_text("1 2 3\n")
    assert run(tmp_path / "bad.xyz", "-o", tmp_path / "other.obj", "--log", log, *WORDS) == ExitCode.INPUT
    assert log.read_text().startswith(first)
    assert "ERROR gnrecon.runtime.logs: InputError: Only 1 of 1 points" in log.read_text()
    assert "Traceback" in log.read_text()
    # Nothing is left behind in this process.
    assert [type(handler) for handler in logging.getLogger("gnrecon").handlers] == [logging.NullHandler]
    assert logging.getLogger("gnrecon").level == logging.NOTSET


def test_verbose_shows_the_log_and_tells_remarks_once(
    scan: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(scan, "-o", tmp_path / "mesh.obj", "-v", *WORDS) == ExitCode.OK
    lines = capfd.readouterr().err.splitlines()
    assert [line.split()[1].rstrip(":") for line in lines if line.startswith("Stage ")] == STAGES
    assert sum(line.startswith("step    1/1") for line in lines) == 1
    assert len(lines) == len(set(lines))
    assert run(scan, "-o", tmp_path / "plain.obj", *WORDS) == ExitCode.OK
    assert not [line for line in capfd.readouterr().err.splitlines() if line.startswith("Stage ")]
    assert (tmp_path / "mesh.obj").read_bytes() == (tmp_path / "plain.obj").read_bytes()


def test_a_log_that_cannot_be_written_is_refused(scan: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before, link, fifo = scan.read_bytes(), tmp_path / "link.log", tmp_path / "fifo.log"
    os.link(scan, link)
    os.mkfifo(fifo)
    for log, code, words in (
        (fifo, ExitCode.OUTPUT, "cannot be written: No such device or address"),
        (link, ExitCode.USAGE, "is named twice"),
        (scan, ExitCode.USAGE, "is named twice"),
        (tmp_path / "mesh.obj", ExitCode.USAGE, "is named twice"),
        (tmp_path / "no" / "run.log", ExitCode.OUTPUT, "cannot be written: No such file or directory"),
    ):
        assert run(scan, "-o", tmp_path / "mesh.obj", "--log", log, *WORDS) == code
        assert words in capfd.readouterr().err
    assert scan.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo.log", "link.log", "ring.ply"]


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
@pytest.mark.parametrize("content", [b"1 2 3\n4 5 6\n", b"ply\nformat ascii 1.0\n", b"{}", b"\x00\xff\x00"])
def test_a_log_is_never_appended_to_another_kind_of_file(
    scan: Path, tmp_path: Path, content: bytes, dry: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    other.write_bytes(content)
    assert run(scan, "-o", tmp_path / "mesh.obj", "--log", other, *WORDS, *dry) == ExitCode.USAGE
    assert "is no log of gnrecon" in capfd.readouterr().err
    assert other.read_bytes() == content
    assert not (tmp_path / "mesh.obj").exists()


def test_a_dry_run_refuses_the_log_that_a_run_would_refuse(scan: Path, tmp_path: Path) -> None:
    words = ["-o", tmp_path / "mesh.obj", "--log", tmp_path / "mesh.obj", *WORDS, "--dry-run"]
    assert run(scan, *words) == ExitCode.USAGE


def test_an_empty_file_may_become_a_log(scan: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    log.touch()
    assert run(scan, "-o", tmp_path / "mesh.obj", "--log", log, *WORDS, "-q") == ExitCode.OK
    assert " gnrecon." in log.read_text()


def test_a_cancelled_run_is_logged(
    cloud: tuple[np.ndarray, np.ndarray], scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    del cloud

    def cancel(*_: object) -> None:
        raise Cancelled

    monkeypatch.setattr("gnrecon.run.ConsoleProgress.stage", cancel)
    assert run(scan, "-o", tmp_path / "mesh.obj", "--log", tmp_path / "run.log") == ExitCode.INTERRUPTED
    assert "Cancelled: Cancelled; nothing was written." in (tmp_path / "run.log").read_text()
