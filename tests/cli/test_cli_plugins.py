"""Commands on files of other packages: verified where they can be read back; a broken package is one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import CommandLine, ball
from other_packages import install, packages

from gnrecon.io import write_mesh
from gnrecon.runtime.errors import ExitCode


@pytest.fixture
def here(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


@pytest.mark.usefixtures("acme_site")
def test_a_written_file_is_read_back_where_a_reader_exists(tmp_path: Path, here: CommandLine) -> None:
    write_mesh(ball(), tmp_path / "ball.obj")
    assert here("convert", tmp_path / "ball.obj", tmp_path / "ball.acmesh").returncode == 0
    assert here("check", tmp_path / "ball.acmesh").returncode == 0
    here.refuses(ExitCode.OUTPUT, "1279 of 1280 faces", "convert", tmp_path / "ball.obj", tmp_path / "ball.lossy")
    assert not (tmp_path / "ball.lossy").exists()
    done = here("convert", tmp_path / "ball.obj", tmp_path / "ball.acme-only")
    assert done.returncode == 0
    assert "ball.acme-only was not read back and verified, because no installed package reads" in done.stderr


@pytest.mark.usefixtures("acme_site")
def test_a_mesh_that_a_writer_spoils_is_not_written(acme_ring: Path, here: CommandLine) -> None:
    words = ("--widths", "200", "--steps", "0", "--resolution", "24")
    here.refuses(ExitCode.MESH, "is open", acme_ring, "-o", acme_ring.with_name("mesh.lossy"), *words, "-q")
    assert sorted(path.name for path in acme_ring.parent.iterdir()) == ["ring.acme", "site"]
    done = here(acme_ring, "-o", acme_ring.with_name("mesh.acme-only"), *words)
    assert done.returncode == 0
    assert "was not read back and verified" in done.stderr


@pytest.mark.parametrize(
    ("code", "exit_code", "sentence"),
    [
        ("import no_such_library", ExitCode.USAGE, "The reader 'bad' of the package badly 1.2 cannot be loaded ("),
        (
            "def read(path):\n    return 1 / 0",
            ExitCode.INPUT,
            "badly 1.2 failed (ZeroDivisionError: division by zero).",
        ),
    ],
)
def test_a_broken_reader_is_one_sentence(
    tmp_path: Path, here: CommandLine, code: str, exit_code: ExitCode, sentence: str
) -> None:
    (tmp_path / "site").mkdir()
    install(tmp_path / "site", "badly", code, readers={"bad": "read"})
    (tmp_path / "scan.bad").write_text("1 2 3\n")
    with packages(tmp_path / "site"):
        here.refuses(exit_code, sentence, tmp_path / "scan.bad", "-o", tmp_path / "mesh.obj")
        here.refuses(exit_code, sentence, "info", tmp_path / "scan.bad")
    assert not (tmp_path / "mesh.obj").exists()
