"""Limits as people write them, what a machine takes at a time, and what is refused before any work."""

from __future__ import annotations

from pathlib import Path

import fake_work
import pytest

from gnrecon.batch import executors
from gnrecon.batch.executors import fitting_jobs
from gnrecon.batch.job import Job, Limits
from gnrecon.batch.plan import parse_megabytes, parse_seconds
from gnrecon.batch.request import Request
from gnrecon.batch.runner import locked_output_folder
from gnrecon.options import Options
from gnrecon.runtime.errors import OutputError, UsageError


def test_times() -> None:
    times = {"90": 90.0, "30s": 30.0, " 1.5 m ": 90.0, "2h": 7200.0, ".5d": 43200.0, "10MIN": 600.0}
    for text, seconds in times.items():
        assert parse_seconds(text) == seconds
    for text in ("", "-3", "0", "soon", "3 weeks", "nan", "1e3"):
        with pytest.raises(UsageError, match="is not a time such as"):
            parse_seconds(text)


def test_amounts_of_memory() -> None:
    amounts = {"800MB": 800.0, "4 gb": 4000.0, "1GiB": 1073.741824, "512MiB": 536.870912}
    for text, megabytes in amounts.items():
        assert parse_megabytes(text) == pytest.approx(megabytes)
    for text in ("", "4", "0GB", "-1GB", "4 apples"):
        with pytest.raises(UsageError, match="is not an amount of memory such as"):
            parse_megabytes(text)


def a_job(folder: Path, limit: float | None = None, **options: object) -> Job:
    values = Options.of(**{"threads": 1, **options}).as_dict()
    return fake_work.job(folder, "scan", "good", Limits(memory_mb=limit), options=values)


def test_as_many_jobs_as_cores_and_memory_allow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "available_cores", lambda: 8)
    monkeypatch.setattr(executors, "available_memory_mb", lambda: 100_000.0)
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=1) == 8
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=3) == 2
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=16) == 1
    assert fitting_jobs([a_job(tmp_path)] * 3, threads=1) == 3
    assert fitting_jobs([a_job(tmp_path, limit=30_000.0)] * 20, threads=1) == 3
    assert fitting_jobs([a_job(tmp_path), a_job(tmp_path, resolution=2048)] * 20, threads=1) == 6
    monkeypatch.setattr(executors, "available_memory_mb", lambda: 100.0)
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=1) == 1


def test_what_this_machine_has_is_positive() -> None:
    assert executors.available_cores() >= 1
    assert executors.available_memory_mb() > 0


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"sources": ()}, "Name a folder, a pattern or scans"),
        ({"sources": ("-",)}, "does not read standard input"),
        ({"mesh_format": "fbx"}, "cannot be written as 'fbx'; use obj, ply"),
        ({"jobs": 0}, "jobs must be positive, not 0"),
        ({"retry": -1}, "must not be negative, not -1"),
    ],
)
def test_requests_that_make_no_sense(values: dict[str, object], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=sentence):
        Request(**{"sources": ("scans",), "output": tmp_path, **values})  # type: ignore[arg-type]


def test_one_batch_at_a_time_works_in_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    with (
        locked_output_folder(folder),
        pytest.raises(UsageError, match="Another batch is running in"),
        locked_output_folder(folder),
    ):
        pass
    with locked_output_folder(folder):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be created"), locked_output_folder(tmp_path / "file"):
        pass
