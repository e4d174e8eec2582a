"""Atomic writing: a target is either complete or unchanged, whatever happens in between."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gnrecon.runtime.errors import MeshError, OutputError
from gnrecon.runtime.files import atomic_write, write_text

REPOSITORY = Path(__file__).resolve().parents[2]


def test_text_arrives_with_the_users_permissions(tmp_path: Path) -> None:
    write_text(tmp_path / "a.json", "{}\n")
    (tmp_path / "plain").write_text("")
    assert (tmp_path / "a.json").read_bytes() == b"{}\n"
    assert (tmp_path / "a.json").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "plain"]


def test_the_temporary_is_hidden_and_keeps_the_suffix(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "mesh.obj") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.startswith(".")
        assert temporary.suffix == ".obj"
        assert not (tmp_path / "mesh.obj").exists()
    assert (tmp_path / "mesh.obj").exists()


def test_existing_files_are_kept_unless_overwriting_is_allowed(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(OutputError, match="exists already"):
        write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "old"
    write_text(tmp_path / "a.txt", "new", overwrite=True)
    assert (tmp_path / "a.txt").read_text() == "new"


def test_a_file_that_appears_meanwhile_is_not_lost(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    with pytest.raises(OutputError, match="created by another process"), atomic_write(target):
        target.write_text("theirs")
    assert target.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [target]


def test_without_hard_links_the_name_is_still_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    write_text(tmp_path / "a.txt", "text")
    assert (tmp_path / "a.txt").read_text() == "text"


def test_failures_leave_nothing(tmp_path: Path) -> None:
    def reject(path: Path) -> None:
        assert path.read_text() == "text"
        raise MeshError("The mesh is open.")

    with pytest.raises(MeshError, match="open"), atomic_write(tmp_path / "a.txt", verify=reject) as temporary:
        temporary.write_text("text")
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "a.txt"):
        raise KeyboardInterrupt
    with pytest.raises(OutputError, match="No space left on device"), atomic_write(tmp_path / "a.txt"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the always-full device")
def test_a_full_disk_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No space left"), atomic_write(tmp_path / "a.txt"):
        Path("/dev/full").write_text("text")


def test_impossible_targets(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"folder .* does not exist"):
        write_text(tmp_path / "missing" / "a.txt", "")
    with pytest.raises(OutputError, match="not a regular file"):
        write_text(tmp_path, "", overwrite=True)
    with pytest.raises(OutputError, match="not a regular file"):
        write_text("/dev/null", "", overwrite=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="Permission denied"):
        write_text(tmp_path / "a.txt", "")


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "folder" / "real.txt")
    write_text(tmp_path / "link.txt", "new", overwrite=True)
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "folder" / "real.txt").read_text() == "new"


@pytest.mark.parametrize("existing", [None, "old"])
def test_a_killed_process_leaves_the_target_as_it_was(tmp_path: Path, existing: str | None) -> None:
    target = tmp_path / "mesh.ply"
    if existing is not None:
        target.write_text(existing)
    script = (
        "import sys, time\nfrom gnrecon.runtime.files import atomic_write\n"
        "with atomic_write(sys.argv[1], overwrite=True) as temporary:\n"
        "    temporary.write_text('half')\n    print('written', flush=True)\n    time.sleep(60)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(target)], stdout=subprocess.PIPE, text=True, cwd=REPOSITORY
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "written\n"
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=10)
    process.stdout.close()
    (left,) = [path for path in tmp_path.iterdir() if path != target]
    assert left.name.startswith(".mesh.")
    assert target.exists() == (existing is not None)
    assert existing is None or target.read_text() == existing


def test_a_failure_within_a_failure_names_the_target(tmp_path: Path) -> None:
    def write_nested() -> None:
        with atomic_write(tmp_path / "a.png") as temporary, atomic_write(temporary, overwrite=True):
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError) as error:
        write_nested()
    assert str(error.value) == f"{tmp_path / 'a.png'} could not be written: No space left on device."
    assert not list(tmp_path.iterdir())
