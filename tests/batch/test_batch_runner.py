"""``gnrecon batch`` as a whole: failures are named and stop nothing, and a batch that was killed is continued."""

from __future__ import annotations

import errno
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import fake_work
import jsonschema
import numpy as np
import psutil
import pytest
from fake_work import notes
from made_shapes import box, sphere
from scan_files import start, torus, write_scan

from gnrecon.batch import executors, runner
from gnrecon.batch.child_process import close_fork_servers
from gnrecon.batch.execute import run_job
from gnrecon.batch.job import JobOutcome, progress_file, running_folder
from gnrecon.batch.request import Request
from gnrecon.batch.runner import locked_output_folder, run_batch
from gnrecon.cli.app import main
from gnrecon.config import Settings, read_settings
from gnrecon.export import verify_file
from gnrecon.report.schema import report_schema
from gnrecon.runtime.errors import ExitCode, InputError, OutputError, UsageError
from gnrecon.runtime.files import sync
from gnrecon.runtime.interrupts import polite_ends

OPTIONS = {"widths": (100,), "steps": 0, "resolution": 24}
WORDS = ("--widths", "100", "--steps", "0", "--resolution", "24")


def write_good(folder: Path) -> list[str]:
    rng = np.random.default_rng(5)
    folder.mkdir()
    write_scan(folder / "ring.ply", *torus(600, rng))
    write_scan(folder / "ball.ply", *sphere(300, rng))
    np.savetxt(folder / "plate.xyz", np.hstack(box(500, rng, (2.0, 1.0, 0.6))))
    return ["ball", "plate", "ring"]


def write_bad(folder: Path) -> None:
    (folder / "torn.ply").write_bytes((folder / "ring.ply").read_bytes()[:5000])
    (folder / "void.ply").touch()
    for name in ("hangs", "killed"):
        (folder / f"{name}.ply").write_bytes((folder / "ring.ply").read_bytes())


def summary(folder: Path) -> dict[str, dict[str, object]]:
    """The summary's entry of each scan, by its name."""
    found = json.loads((folder / "summary.json").read_text())
    assert found["failed"] == sum(scan["status"] == "failed" for scan in found["scans"])
    return {scan["name"]: scan for scan in found["scans"]}


@contextmanager
def accidents(output: Path) -> Iterator[None]:
    """Kill the child of the scan "killed", and stop that of "hangs", as soon as they run."""
    over = threading.Event()

    def signal_children() -> None:
        while not over.wait(0.02):
            for name, number in (("killed", signal.SIGSEGV), ("hangs", signal.SIGSTOP)):
                for progress in map(progress_file, running_folder(output).glob(f"{name}-*")):
                    with suppress(OSError, ValueError):
                        os.kill(json.loads(progress.read_text())["pid"], number)

    thread = threading.Thread(target=signal_children)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def files(folder: Path, *, names: Callable[[Path], bool]) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file() and names(path)}


def test_a_batch_that_was_killed_is_continued_and_every_failure_is_named(tmp_path: Path) -> None:
    scans, meshes = tmp_path / "scans", tmp_path / "new" / "meshes"
    good = write_good(scans)
    write_bad(scans)
    words = ("batch", scans, "-o", meshes, *WORDS, "--format", "ply", "--jobs", 1, "--timeout", "20m")
    process = start(*words)
    records = meshes / ".gnrecon" / "records"
    while process.poll() is None and not list(records.glob("[a-z]*.json")):
        time.sleep(0.02)
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    # Nothing that it had started outlives it.
    assert not psutil.wait_procs(children, timeout=20)[1]
    finished = [path.stem for path in records.glob("[a-z]*.json")]
    assert 1 <= len(finished) < len(good)
    config = tmp_path / "batch.toml"
    config.write_text('[scans."hangs.*"]\ntimeout = "2s"\n')
    request = Request(
        (str(scans),),
        meshes,
        mesh_format="ply",
        settings=read_settings(config, [], OPTIONS),
        jobs=2,
        quiet=True,
    )
    with accidents(meshes):
        assert run_batch(request) == ExitCode.BATCH
    listed = summary(meshes)
    assert {name for name, scan in listed.items() if scan["status"] == "unchanged"} == set(finished)
    assert {name for name, scan in listed.items() if scan["status"] != "failed"} == set(good)
    causes = {name: (scan["cause"], scan["message"]) for name, scan in listed.items() if scan["status"] == "failed"}
    assert causes == {
        "torn": ("input", f"{scans}/torn.ply: the header declares 600 vertex rows, but the file ends after 100."),
        "void": ("input", f"{scans}/void.ply: the file is empty."),
        "killed": ("signal", "Killed by SIGSEGV."),
        "hangs": ("timeout", "It had not ended after 2 s, which is the limit (--timeout)."),
    }
    assert not list(running_folder(meshes).glob("*"))
    # An undisturbed run of the good ones makes the same bytes, with any number of jobs and any other files.
    for name in ("torn.ply", "void.ply", "hangs.ply", "killed.ply"):
        (scans / name).unlink()
    alone = replace(request, output=tmp_path / "alone", jobs=3, kinds=("report", "page"))
    assert run_batch(alone) == ExitCode.OK
    is_mesh = lambda path: path.suffix == ".ply"  # noqa: E731
    assert files(meshes, names=is_mesh) == files(tmp_path / "alone", names=is_mesh)
    assert verify_file(meshes / "ring.ply").closed
    report = json.loads((tmp_path / "alone" / "ring.report.json").read_text())
    jsonschema.validate(report, report_schema())
    assert (report["input"], report["resources"]["threads"]) == (str(scans / "ring.ply"), 1)
    assert "ring.config.toml" in (tmp_path / "alone" / "ring.html").read_text(encoding="utf-8")
    # And so does a single run with the options in effect.
    same = tmp_path / "same.ply"
    assert (
        command(
            "reconstruct",
            scans / "ring.ply",
            "-o",
            same,
            "--config",
            tmp_path / "alone" / "ring.config.toml",
            "--quiet",
        )
        == 0
    )
    assert same.read_bytes() == (meshes / "ring.ply").read_bytes()


def command(*words: object) -> int:
    """Run the command line within this process; return its exit code."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as end:
            main([str(word) for word in words])
    finally:
        signal.signal(signal.SIGTERM, handler)
    return int(end.value.code or 0)


@pytest.fixture
def errand_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let batches in this process run the fake work."""
    monkeypatch.setattr(executors, "run_job", lambda *words: run_job(*words, work=fake_work.WORK))


def write_errands(folder: Path, **texts: str) -> Path:
    folder.mkdir()
    for name, text in texts.items():
        (folder / f"{name}.ply").write_text(text)
    return folder


@pytest.mark.usefixtures("errand_runs")
def test_a_summary_is_written_and_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scans = write_errands(tmp_path / "scans", a="good", b="exit 4", c="good", d="signal SIGABRT")
    request = Request((str(scans),), tmp_path / "out", jobs=2, kinds=("model",), command="gnrecon batch scans")
    assert run_batch(request) == ExitCode.BATCH
    captured = capfd.readouterr()
    assert captured.out == ""
    assert "2 of 4 scans reconstructed, in " in captured.err
    assert "failed: 1 fit, 1 signal." in captured.err
    assert f"{scans}/a.ply: {tmp_path}/out/a.obj (made)" in captured.err
    assert [(scan["status"], scan["cause"]) for scan in summary(tmp_path / "out").values()] == [
        ("made", None), ("failed", "fit"), ("made", None), ("failed", "signal")
    ]  # fmt: skip
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {
        ".gnrecon",
        "a.obj",
        "a.gnr",
        "a.config.toml",
        "c.obj",
        "c.gnr",
        "c.config.toml",
        "summary.json",
        "summary.csv",
        "summary.html",
    }
    # The failures are tried again, the others left as they are.
    (scans / "b.ply").write_text("good")
    (scans / "d.ply").unlink()
    assert run_batch(replace(request, quiet=True)) == ExitCode.OK
    assert capfd.readouterr() == ("", "")
    *first, second = notes(scans, "ended")
    assert (sorted(first), second) == (["a", "c"], "b")  # two jobs end in any order


@pytest.mark.usefixtures("errand_runs")
def test_names_and_folders(tmp_path: Path) -> None:
    scans = write_errands(tmp_path / "scans", a="good", b="good")
    write_errands(scans / "deep", a="good")
    request = Request((str(scans),), tmp_path / "out", recursive=True, jobs=3, quiet=True)
    assert run_batch(request) == ExitCode.OK
    assert sorted(summary(tmp_path / "out")) == ["a", "b", "deep/a"]
    assert (tmp_path / "out" / "deep" / "a.obj").is_file()
    assert run_batch(replace(request, name="{parent}-{stem}")) == ExitCode.OK
    assert (tmp_path / "out" / "deep-a.obj").is_file()


@pytest.mark.usefixtures("errand_runs")
def test_an_interrupted_batch_writes_its_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    scans = write_errands(tmp_path / "scans", a="good", b="good 60", c="good")

    class Impatient(runner.ProgressBoard):
        def done(self, outcome: JobOutcome) -> None:
            raise KeyboardInterrupt(outcome.name)

    def impatient_close() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        close_fork_servers()

    monkeypatch.setattr(runner, "ProgressBoard", Impatient)
    monkeypatch.setattr(executors, "close_fork_servers", impatient_close)
    began = time.monotonic()
    request = Request((str(scans),), tmp_path / "out", jobs=2, quiet=True)
    with polite_ends():
        assert run_batch(request) == ExitCode.INTERRUPTED
    assert time.monotonic() - began < 30
    written = tmp_path / "out" / "summary.json"
    assert list(summary(tmp_path / "out")) == ["a"]
    assert json.loads(written.read_text())["scans_asked_for"] == 3
    assert capfd.readouterr().err == f"gnrecon: Interrupted; {written} lists what was done until then.\n"
    assert not list(running_folder(tmp_path / "out").glob("*"))
    assert not (tmp_path / "out" / "b.obj").exists()


def fill_disk(monkeypatch: pytest.MonkeyPatch, *stems: str) -> None:
    """Let the disk be full wherever a file of such a name is written, or moved into place, by this process."""

    def flush(path: Path) -> None:
        if path.name.startswith(tuple(f".{stem}." for stem in stems)):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        sync(path)

    monkeypatch.setattr("gnrecon.runtime.files.sync", flush)


@pytest.mark.usefixtures("errand_runs")
def test_a_full_disk_costs_scans_and_not_the_summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = write_errands(tmp_path / "scans", a="good", b="good", c="good")
    fill_disk(monkeypatch, "b")
    assert run_batch(Request((str(scans),), tmp_path / "out", jobs=1, quiet=True)) == ExitCode.BATCH
    found = summary(tmp_path / "out")
    assert {name: scan["cause"] for name, scan in found.items()} == {"a": None, "b": "output", "c": None}
    assert str(found["b"]["message"]).endswith("b.json could not be written: No space left on device.")
    assert not (tmp_path / "out" / "b.obj").exists()


@pytest.mark.usefixtures("errand_runs")
def test_a_summary_that_finds_no_space_is_announced_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    scans = write_errands(tmp_path / "scans", a="good")
    fill_disk(monkeypatch, "summary")
    with pytest.raises(OutputError, match=r"summary.json could not be written: No space left on device\.$"):
        run_batch(Request((str(scans),), tmp_path / "out", jobs=1))
    assert "1 of 1 scans reconstructed" in capfd.readouterr().err
    assert (tmp_path / "out" / "a.obj").is_file()


def test_what_is_refused_before_any_scan(tmp_path: Path) -> None:
    out = tmp_path / "meshes"
    with pytest.raises(InputError, match="no file or folder"):
        run_batch(Request((str(tmp_path / "missing"),), out))
    (tmp_path / "README.md").touch()
    with pytest.raises(InputError, match="There are no scans in"):
        run_batch(Request((str(tmp_path),), out))
    (tmp_path / "a.obj").touch()
    with pytest.raises(UsageError, match=r"a\.obj is an input of the batch"):
        run_batch(Request((str(tmp_path),), tmp_path))
    with pytest.raises(UsageError, match="resolution must be at least 16"):
        run_batch(Request((str(tmp_path),), out, settings=Settings({"resolution": 3})))
    with pytest.raises(OutputError, match="cannot be created"):
        run_batch(Request((str(tmp_path),), tmp_path / "README.md" / "meshes"))
    with pytest.raises(OutputError, match=r"cannot be created: File name too long\.$"):
        run_batch(Request((str(tmp_path),), tmp_path / ("n" * 300)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["README.md", "a.obj"]


def test_what_scans_and_options_name_is_no_output(tmp_path: Path) -> None:
    scans, other = tmp_path / "scans", tmp_path / "other"
    scans.mkdir()
    other.mkdir()
    (scans / "poses.conf").write_text("bmesh poses.ply 0 0 0 0 0 0 1\n")
    for path in (scans / "poses.ply", other / "poses.config.toml", other / "poses.ply"):
        path.write_text("seed = 1\n")
    source = str(scans / "poses.conf")
    with pytest.raises(UsageError, match=r"poses\.ply is an input of the batch"):
        run_batch(Request((source,), scans, mesh_format="ply", overwrite=True))
    with pytest.raises(UsageError, match=r"poses\.ply is an input of the batch"):
        run_batch(Request((source,), other, mesh_format="ply", references=other, overwrite=True))
    settings = read_settings(other / "poses.config.toml", (), {})
    with pytest.raises(UsageError, match=r"poses\.config\.toml is an input of the batch"):
        run_batch(Request((source,), other, settings=settings, overwrite=True))
    assert (scans / "poses.ply").read_text() == "seed = 1\n"


def test_a_summary_replaces_no_scan_no_list_and_no_file_of_others(tmp_path: Path) -> None:
    table, out = tmp_path / "summary.csv", tmp_path / "meshes"
    table.write_text("a.ply\n")
    (tmp_path / "Summary.ply").write_text("any")
    for request, sentence in (
        (Request((str(table),), tmp_path, overwrite=True), r"summary\.csv is an input of the batch, whose summary"),
        (Request((str(tmp_path / "Summary.ply"),), out, kinds=("page",)), r"Summary\.html would be an output of"),
    ):
        with pytest.raises(UsageError, match=sentence):
            run_batch(request)
    (tmp_path / "a.ply").write_text("any")
    with pytest.raises(OutputError, match=r"summary\.csv exists already and was not written by a batch"):
        run_batch(Request((str(tmp_path / "a.ply"),), tmp_path))
    os.link(table, tmp_path / "a.obj")
    with pytest.raises(UsageError, match=r"a\.obj is an input of the batch"):
        run_batch(Request((str(tmp_path / "a.ply"),), tmp_path, lists=(table,), overwrite=True))
    assert table.read_text() == "a.ply\n"
    assert not out.exists()


def test_a_missing_folder_has_its_exit_code(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert command("batch", tmp_path / "missing", "-o", tmp_path / "meshes") == ExitCode.INPUT
    assert capfd.readouterr() == ("", f"gnrecon: There is no file or folder {tmp_path / 'missing'}.\n")
    assert not (tmp_path / "meshes").exists()


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
