"""One job: failures are named, partial outputs are removed, and nothing is done twice."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import fake_work
import psutil
import pytest
from fake_work import job, notes

from gnrecon.batch.child_process import close_fork_servers
from gnrecon.batch.execute import run_job
from gnrecon.batch.job import Cause, Job, JobOutcome, Limits, Status, read_record, running_folder
from gnrecon.batch.runner import locked_output_folder
from gnrecon.runtime.errors import ExitCode


@pytest.fixture(scope="module", autouse=True)
def fork_servers() -> Iterator[None]:
    yield
    close_fork_servers()


def done(one: Job, stop: threading.Event | None = None) -> JobOutcome:
    outcome = run_job(one, stop, work=fake_work.WORK)
    assert not list(running_folder(one.output).glob("*"))
    return outcome


def outputs(one: Job) -> list[str]:
    return sorted(path.relative_to(one.output).as_posix() for path in one.output.rglob("*") if path.is_file())


def test_a_result_has_its_files_and_its_record(tmp_path: Path) -> None:
    one = job(tmp_path, "good", "good", kinds=("page", "report"))
    outcome = done(one)
    assert (outcome.status, outcome.cause, outcome.exit_code, outcome.attempts) == (Status.MADE, None, 0, 1)
    assert outputs(one) == [
        ".gnrecon/logs/good.log",
        ".gnrecon/records/good.json",
        ".gnrecon/thumbnails/good.png",
        "good.html",
        "good.obj",
        "good.report.json",
    ]
    assert one.log().read_text() == "words of good.ply\n"
    assert outcome.files["report"] == str(one.output / "good.report.json")
    assert outcome.figures["faces"] == 4


def test_an_unchanged_result_is_not_made_again(tmp_path: Path) -> None:
    one = job(tmp_path, "good", "good")
    first, second = done(one), done(one)
    assert second == replace(first, status=Status.UNCHANGED, attempts=0, seconds=0.0)
    assert notes(tmp_path / "scans", "ended") == ["good"]


@pytest.mark.parametrize(
    "change", ["scan", "options", "format", "kinds", "reference", "gone", "broken record", "fresh"]
)
def test_any_change_makes_the_result_again(tmp_path: Path, change: str) -> None:
    one = job(tmp_path, "good", "good")
    done(one)
    other = one
    if change == "scan":
        one.scan.write_text("good 0 changed")
    if change == "options":
        other = replace(one, options={**one.options, "resolution": 64})
    if change == "format":
        other = replace(one, mesh_format="ply")
    if change == "kinds":
        other = replace(one, kinds=("model",))
    if change == "reference":
        other = replace(one, reference=one.scan)
    if change == "gone":
        (one.output / "good.obj").unlink()
    if change == "broken record":
        one.record().write_text("{")
        other = replace(one, overwrite=True)
    if change == "fresh":
        other = replace(one, fresh=True)
    assert done(other).status == Status.MADE
    assert done(replace(other, fresh=False)).status == Status.UNCHANGED
    assert notes(tmp_path / "scans", "ended") == ["good", "good"]


def test_files_that_others_wrote_or_changed_are_kept(tmp_path: Path) -> None:
    one = job(tmp_path, "good", "good")
    mesh = one.output / "good.obj"
    mesh.write_text("by hand")
    outcome = done(one)
    assert (outcome.cause, outcome.exit_code, outcome.attempts) == (Cause.OUTPUT, ExitCode.OUTPUT, 0)
    assert "was not written by this batch" in outcome.message
    assert mesh.read_text() == "by hand"
    assert done(replace(one, overwrite=True)).status == Status.MADE
    mesh.write_text("retouched")
    assert done(one).cause == Cause.OUTPUT
    assert mesh.read_text() == "retouched"


def test_records_of_earlier_versions_are_read(tmp_path: Path) -> None:
    one = job(tmp_path, "good", "good")
    first = done(one)
    values = json.loads(one.record().read_text())
    values["told"] = values.pop("facts")
    one.record().write_text(json.dumps(values))
    assert done(one) == replace(first, status=Status.UNCHANGED, attempts=0, seconds=0.0)


def test_a_batch_killed_before_files_were_moved_moves_them_at_its_next_start(tmp_path: Path) -> None:
    one = job(tmp_path, "deep/good", "good", kinds=("page",))
    first = done(one)
    record = read_record(one.record())
    assert record is not None
    for name in record.outputs:
        staged = one.output / record.staged / name
        staged.parent.mkdir(parents=True, exist_ok=True)
        (one.output / name).rename(staged)
    with locked_output_folder(one.output):
        assert done(one) == replace(first, status=Status.UNCHANGED, attempts=0, seconds=0.0)


def test_a_batch_killed_before_files_were_moved_knows_them_as_its_own(tmp_path: Path) -> None:
    one = job(tmp_path, "good", "good")
    done(one)
    old = (one.output / "good.obj").read_bytes()
    newer = replace(one, options={**one.options, "seed": 1})
    done(newer)
    # As if it had been killed between the record and the renaming.
    (one.output / "good.obj").write_bytes(old)
    record = read_record(one.record())
    assert record is not None
    assert set(record.replaced) == {"good.obj"}
    assert done(newer).status == Status.MADE
    assert (one.output / "good.obj").read_bytes() != old


@pytest.mark.parametrize(
    ("text", "limits", "cause", "code", "words"),
    [
        ("exit 3", Limits(), Cause.INPUT, 3, "bad.ply ends with 3."),
        ("exit 4", Limits(), Cause.FIT, 4, "bad.ply ends with 4."),
        ("exit 5", Limits(), Cause.MESH, 5, "bad.ply ends with 5."),
        ("exit 7", Limits(), Cause.MEMORY, 7, "bad.ply ends with 7."),
        ("exit 1", Limits(), Cause.UNFORESEEN, 1, "bad.ply ends with 1."),
        ("exit 77", Limits(), Cause.UNFORESEEN, 77, "bad.ply ends with 77."),
        ("signal SIGSEGV", Limits(), Cause.SIGNAL, -signal.SIGSEGV, "Killed by SIGSEGV."),
        ("signal SIGKILL", Limits(), Cause.SIGNAL, -signal.SIGKILL, "Killed by SIGKILL. Perhaps the system"),
        ("sleep", Limits(seconds=0.5), Cause.TIMEOUT, None, "It had not ended after 0.5 s"),
        ("hog", Limits(memory_mb=200.0), Cause.MEMORY, 7, "the limit is 200 MB"),
        (
            "native what(): std::bad_alloc",
            Limits(),
            Cause.MEMORY,
            7,
            "ran out in native code, which ended it by SIGABRT",
        ),
        ("native assertion failed", Limits(), Cause.SIGNAL, -signal.SIGABRT, "Killed by SIGABRT."),
        ("nonsense", Limits(), Cause.UNFORESEEN, 1, "Its process ended with exit code 1."),
    ],
)
def test_failures_are_named(
    tmp_path: Path, text: str, limits: Limits, cause: Cause, code: int | None, words: str
) -> None:
    outcome = done(job(tmp_path, "bad", text, limits))
    assert (outcome.status, outcome.cause, outcome.exit_code) == (Status.FAILED, cause, code)
    assert words in outcome.message
    assert outcome.files == {}
    assert outputs(job(tmp_path, "bad", text)) == [".gnrecon/logs/bad.log"]


def test_a_kill_by_the_system_for_memory_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kills = iter((3, 4))
    monkeypatch.setattr("gnrecon.batch.execute.kills_for_memory", lambda: next(kills))
    outcome = done(job(tmp_path, "bad", "signal SIGKILL"))
    assert (outcome.cause, outcome.exit_code) == (Cause.MEMORY, ExitCode.MEMORY)


def test_a_scan_that_is_missing_is_an_input_error(tmp_path: Path) -> None:
    one = job(tmp_path, "good", "good")
    one.scan.unlink()
    outcome = done(one)
    assert (outcome.cause, outcome.exit_code) == (Cause.INPUT, ExitCode.INPUT)
    assert "No such file" in outcome.message


def test_only_transient_failures_are_tried_again(tmp_path: Path) -> None:
    assert done(job(tmp_path, "bad", "exit 3", retry=2)).attempts == 1
    outcome = done(job(tmp_path, "killed", "signal SIGABRT", retry=2))
    assert (outcome.attempts, outcome.message) == (3, "Killed by SIGABRT.")
    outcome = done(job(tmp_path, "once", f"signal SIGBUS {tmp_path / 'was'}", retry=2))
    assert (outcome.attempts, outcome.status) == (2, Status.MADE)


def test_a_failed_scan_is_tried_again_by_the_next_batch(tmp_path: Path) -> None:
    one = job(tmp_path, "bad", "exit 3")
    assert done(one).failed
    assert done(one).failed
    assert notes(tmp_path / "scans", "began") == ["bad", "bad"]


def test_a_limit_ends_all_that_a_child_has_started(tmp_path: Path) -> None:
    before = {process.pid for process in psutil.process_iter()}
    done(job(tmp_path, "bad", "sleep", Limits(seconds=0.5)))
    left = [p for p in psutil.process_iter(["cmdline"]) if p.pid not in before and p.info["cmdline"] == ["sleep", "60"]]
    psutil.wait_procs(left, timeout=5)
    assert not [process for process in left if process.is_running()]


def test_a_stop_ends_a_running_scan(tmp_path: Path) -> None:
    stop = threading.Event()
    threading.Timer(0.4, stop.set).start()
    start = time.monotonic()
    outcome = done(job(tmp_path, "long", "good 30", retry=3), stop)
    assert (outcome.cause, outcome.attempts) == (Cause.INTERRUPTED, 1)
    assert time.monotonic() - start < 20


def test_temporary_files_of_libraries_are_deleted(tmp_path: Path) -> None:
    done(job(tmp_path, "bad", "litter"))
    assert not list(tmp_path.rglob("left"))


def test_a_fork_server_that_was_killed_is_started_again(tmp_path: Path) -> None:
    done(job(tmp_path, "first", "good"))
    server = fork_server()
    threading.Timer(0.5, lambda: os.kill(server, signal.SIGKILL)).start()
    assert done(job(tmp_path, "second", "good 1.5")).status == Status.MADE
    assert notes(tmp_path / "scans", "began") == ["first", "second", "second"]
    assert notes(tmp_path / "scans", "ended") == ["first", "second"]


def fork_server() -> int:
    (server,) = [p.pid for p in psutil.Process().children() if "gnrecon.batch.fork_server" in p.cmdline()]
    return server


def test_signals_of_a_closed_terminal_or_a_service_manager_leave_the_fork_server(tmp_path: Path) -> None:
    done(job(tmp_path, "first", "good"))
    server = fork_server()
    assert os.getsid(server) == server
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        os.kill(server, number)
    assert done(job(tmp_path, "second", "good")).status == Status.MADE
    assert done(job(tmp_path, "third", "signal SIGTERM")).message == "Killed by SIGTERM."
    assert fork_server() == server


def test_work_that_should_end_is_not_begun_again(tmp_path: Path) -> None:
    done(job(tmp_path, "first", "good"))
    stop = threading.Event()

    def end() -> None:
        stop.set()
        os.kill(fork_server(), signal.SIGKILL)

    threading.Timer(0.5, end).start()
    assert done(job(tmp_path, "second", "good 5"), stop).failed
    assert notes(tmp_path / "scans", "began") == ["first", "second"]
    close_fork_servers()
