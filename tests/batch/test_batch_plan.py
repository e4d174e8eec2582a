"""Scans find their references by the names of the files, and jobs are what the settings say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gnrecon.batch.job import Limits
from gnrecon.batch.plan import plan
from gnrecon.batch.request import Request
from gnrecon.config import Settings, read_settings
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.runtime.typed_values import parse_megabytes, parse_seconds


@pytest.fixture
def request_of(tmp_path: Path) -> Request:
    for name in (
        "scans/a.ply",
        "scans/b.xyz",
        "scans/left/a.ply",
        "truth/a.obj",
        "truth/left/a.stl",
        "truth/b_cad.off",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return Request((str(tmp_path / "scans"),), tmp_path / "out", recursive=True)


def pairs(request: Request, folder: Path) -> dict[str, str | None]:
    return {
        job.name: None if job.reference is None else job.reference.relative_to(folder).as_posix()
        for job in plan(request)
    }


def test_by_stem_in_the_same_subfolder_or_in_the_folder_itself(request_of: Request, tmp_path: Path) -> None:
    request = _with(request_of, references=tmp_path / "truth")
    assert pairs(request, tmp_path) == {"a": "truth/a.obj", "b": None, "left/a": "truth/left/a.stl"}


def test_by_template(request_of: Request, tmp_path: Path) -> None:
    request = _with(request_of, references=tmp_path / "truth", reference_name="{stem}_cad")
    assert pairs(request, tmp_path) == {"a": None, "b": "truth/b_cad.off", "left/a": None}
    request = _with(request_of, references=tmp_path / "truth", reference_name="{stem}_cad.off")
    assert pairs(request, tmp_path)["b"] == "truth/b_cad.off"


def test_by_the_configuration(request_of: Request, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('[scans."b.*"]\nreference = "truth/b_cad.off"\n')
    request = _with(request_of, settings=read_settings(tmp_path / "c.toml", [], {}))
    assert pairs(request, tmp_path) == {"a": None, "b": "truth/b_cad.off", "left/a": None}


def test_references_that_make_no_sense(request_of: Request, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"There is no folder .*nowhere"):
        plan(_with(request_of, references=tmp_path / "nowhere"))
    with pytest.raises(UsageError, match="None of the scans has a reference in"):
        plan(_with(request_of, references=tmp_path / "truth", reference_name="{index}"))
    with pytest.raises(UsageError, match="add --reference-dir"):
        _with(request_of, reference_name="{stem}")


def test_jobs_have_their_own_options_and_limits(request_of: Request) -> None:
    tables = (("left/*", {"resolution": 64, "threads": 4, "timeout": "2m", "memory": "1GB"}),)
    request = _with(request_of, settings=Settings({"seed": 5, "timeout": "1h"}, tables))
    jobs = {job.name: job for job in plan(request)}
    assert [jobs["a"].options[name] for name in ("seed", "resolution", "threads")] == [5, None, 1]
    assert [jobs["left/a"].options[name] for name in ("seed", "resolution", "threads")] == [5, 64, 4]
    assert (jobs["a"].limits, jobs["left/a"].limits) == (Limits(3600.0), Limits(120.0, 1000.0))
    assert "resolution = 64\n" in jobs["left/a"].config


def test_each_scan_has_a_work_folder_of_its_own(request_of: Request) -> None:
    jobs = plan(_with(request_of, settings=Settings({"work_dir": "work"})))
    assert {job.options["work_dir"] for job in jobs} == {"work/a", "work/b", "work/left/a"}


def _with(request: Request, **values: object) -> Request:
    return replace(request, **values)  # type: ignore[arg-type]


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
