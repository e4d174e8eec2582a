"""How commands end: targets that cannot be written are refused early, and no stream or signal breaks an end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from command_line import CommandLine, ball, cube
from scan_files import start, torus, wait_for

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import write_cloud, write_mesh
from gnrecon.runtime.errors import ExitCode, InputError, MeshError
from gnrecon.runtime.interrupts import polite_ends
from gnrecon.runtime.plugins import guarded

FULL = "gnrecon: Standard output could not be written: No space left on device.\n"
FEW = ("--quality", "draft", "--resolution", "16")


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    points, normals = torus(300, np.random.default_rng(0))
    write_cloud(PointCloud(points, normals), tmp_path / "scan.ply")
    return tmp_path / "scan.ply"


@pytest.fixture
def no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    def fitted(*_: object, **__: object) -> None:
        raise AssertionError("the fit has begun")

    monkeypatch.setattr("gnrecon.run.reconstruct", fitted)


@pytest.mark.usefixtures("no_fit")
@pytest.mark.parametrize("option", ["-o", "--report", "--save"])
@pytest.mark.parametrize("kind", ["folder", "fifo", "loop", "proc", "long", "too long", "device"])
def test_what_cannot_be_written_is_refused_before_the_fit(
    command: CommandLine, scan: Path, tmp_path: Path, option: str, kind: str
) -> None:
    suffix = {"-o": ".ply", "--report": ".json", "--save": ".gnr"}[option]
    target = tmp_path / f"target{suffix}"
    if kind == "folder":
        target.mkdir()
    elif kind == "fifo":
        os.mkfifo(target)
    elif kind == "loop":
        target.symlink_to(target.name)
    elif kind == "proc":
        target = Path(f"/proc/target{suffix}")
    elif kind == "device":
        target.symlink_to("/dev/full")
    else:
        target = tmp_path / ("a" * ((255 if kind == "long" else 256) - len(suffix)) + suffix)
    before = sorted(tmp_path.iterdir())
    words = [scan, "-o", target] if option == "-o" else [scan, "-o", tmp_path / "mesh.ply", option, target]
    if kind == "long":
        assert "the fit has begun" in command(*words, "--overwrite").stderr
    else:
        command.refuses(ExitCode.OUTPUT, "written", *words, "--overwrite")
    assert sorted(tmp_path.iterdir()) == before


def test_a_name_may_be_as_long_as_the_system_allows(command: CommandLine, tmp_path: Path) -> None:
    write_mesh(cube(), tmp_path / "cube.ply")
    long = tmp_path / f"{'é' * 125}.obj"
    assert command("convert", tmp_path / "cube.ply", long).returncode == ExitCode.OK
    assert long.is_file()


def test_a_scan_whose_name_is_too_long_is_missing(command: CommandLine, tmp_path: Path) -> None:
    command.refuses(ExitCode.INPUT, "no file", tmp_path / f"{'a' * 300}.ply", "-o", tmp_path / "mesh.ply")


def outcome(words: list[object], shell: str) -> subprocess.CompletedProcess[str]:
    """Run the command line, its streams redirected by the end of a shell's line."""
    line = 'exec "$0" -m gnrecon "$@" ' + shell
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = ["bash", "-c", line, sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=100)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the always-full device")
@pytest.mark.parametrize(
    ("shell", "code"), [(">/dev/full", ExitCode.OUTPUT), ("2>&- >&-", ExitCode.OK), ("> >(exit)", ExitCode.OK)]
)
def test_results_that_nobody_takes(shell: str, code: ExitCode) -> None:
    done = outcome(["schema"], shell)
    assert done.returncode == code
    assert done.stderr == ("" if code == ExitCode.OK else FULL)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the always-full device")
@pytest.mark.parametrize(("shell", "code"), [(">/dev/full", ExitCode.OUTPUT), ("2>/dev/full", ExitCode.OK)])
def test_streams_do_not_end_a_run_whose_files_were_written(tmp_path: Path, shell: str, code: ExitCode) -> None:
    write_mesh(ball(1.0, 2), tmp_path / "a.ply")
    write_mesh(ball(1.01, 2), tmp_path / "b.ply")
    done = outcome(
        ["eval", tmp_path / "a.ply", "--reference", tmp_path / "b.ply", "--json", tmp_path / "r.json"], shell
    )
    assert (done.returncode, (tmp_path / "r.json").is_file()) == (code, True), done.stderr
    assert done.stderr == ("" if code == ExitCode.OK else FULL)


def test_a_log_on_a_full_device_is_announced_once(command: CommandLine, scan: Path, tmp_path: Path) -> None:
    done = command(scan, "-o", tmp_path / "mesh.ply", "--log", "/dev/full", *FEW)
    assert done.returncode == ExitCode.OK
    assert done.stderr.count("The log /dev/full is not complete") == 1
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_no_library_swallows_a_signal(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with polite_ends(), pytest.raises(KeyboardInterrupt), guarded(InputError, str), suppress(BaseException):
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with polite_ends():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


SWALLOW = """
import sys, time, trimesh
def load(*_, **__):
    try:
        print("paused", file=sys.stderr, flush=True)
        time.sleep(60)
    except BaseException as error:
        raise ValueError("bad") from error
trimesh.load_scene = load
"""


def test_a_signal_that_a_library_takes_for_a_bad_file_still_ends_the_run(tmp_path: Path) -> None:
    write_mesh(cube(), tmp_path / "cube.glb")
    words = (tmp_path / "cube.glb", "-o", tmp_path / "mesh.ply")
    process = start(*words, before=SWALLOW)
    try:
        wait_for(process, "paused")
        process.send_signal(signal.SIGHUP)
        _, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert (process.returncode, stderr) == (ExitCode.INTERRUPTED, "gnrecon: Interrupted; nothing was written.\n")
    assert [path.name for path in tmp_path.iterdir()] == ["cube.glb"]


def test_a_signal_before_the_first_step_of_learning_ends_it(
    command: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which an optimiser of the start takes for its own end."""

    def freeze(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("gnrecon.shape_learning.shape_problem.ShapeProblem.freeze", freeze)
    words = ("learn", "catenoid", "-o", tmp_path / "mesh.ply", "--steps", "1", "--resolution", "16")
    command.refuses(ExitCode.INTERRUPTED, "Interrupted; nothing was written.", *words)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_after_a_signal_is_an_interruption(
    command: CommandLine, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object, **__: object) -> None:
        with suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        raise MeshError("The field has no zero level.")

    monkeypatch.setattr("gnrecon.run.reconstruct", failing)
    command.refuses(ExitCode.INTERRUPTED, "Interrupted; nothing was written.", scan, "-o", tmp_path / "mesh.ply")


def test_a_signal_while_files_get_their_names_is_too_late(
    command: CommandLine, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the mesh would lack its report, and a sentence would say that nothing was written."""

    def rename(temporary: Path, target: Path, overwrite: bool) -> None:
        assert not overwrite
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGHUP)
        temporary.replace(target)

    monkeypatch.setattr("gnrecon.runtime.files._rename", rename)
    done = command(scan, "-o", tmp_path / "mesh.ply", "--report", tmp_path / "mesh.json", "-q", *FEW)
    assert (done.returncode, done.stderr) == (ExitCode.OK, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mesh.json", "mesh.ply", "scan.ply"]


def test_names_command_no_terminal(command: CommandLine, scan: Path, tmp_path: Path) -> None:
    odd = tmp_path / "a\n\x1b[31m\r.ply"
    scan.rename(odd)
    target, log = tmp_path / "mesh\x1b[2J.ply", tmp_path / "log"
    done = command(odd, "-o", target, "--log", log, "-v", *FEW)
    assert (done.returncode, target.is_file()) == (ExitCode.OK, True)
    command.refuses(ExitCode.OUTPUT, r"mesh\x1b[2J.ply exists already", odd, "-o", target)
    for text in (done.stderr, log.read_bytes().decode()):
        assert r"a\n\x1b[31m\r" in text
        assert not {"\x1b", "\r"} & set(text)
