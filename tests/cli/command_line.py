"""The command line within the tests' own process, and small meshes with known facts in files."""

from __future__ import annotations

import signal
import subprocess

import pytest
import trimesh

from gnrecon.cli.app import main
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import ExitCode


class CommandLine:
    """Runs commands and keeps their exit code and streams."""

    def __init__(self, capfd: pytest.CaptureFixture[str]) -> None:
        self._capfd = capfd

    def __call__(self, *words: object) -> subprocess.CompletedProcess[str]:
        """Run one command."""
        arguments = [str(word) for word in words]
        handler = signal.getsignal(signal.SIGTERM)
        try:
            with pytest.raises(SystemExit) as end:
                main(arguments)
        finally:
            signal.signal(signal.SIGTERM, handler)
        stdout, stderr = self._capfd.readouterr()
        return subprocess.CompletedProcess(arguments, int(end.value.code or 0), stdout, stderr)

    def refuses(self, code: ExitCode, sentence: str, *words: object) -> None:
        """Run a command that must end in one sentence on stderr, which holds `sentence`, and print nothing."""
        done = self(*words)
        assert (done.returncode, done.stdout) == (code, ""), done.stderr
        assert done.stderr.startswith("gnrecon: ")
        assert done.stderr.count("\n") == 1
        assert sentence in done.stderr


def ball(radius: float = 1.0, subdivisions: int = 3) -> Mesh:
    """A sphere of 20 * 4^subdivisions faces."""
    made = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(made.vertices, made.faces)


def cube(side: float = 2.0) -> Mesh:
    """A cube of 12 faces around the origin."""
    made = trimesh.creation.box((side, side, side))
    return Mesh(made.vertices, made.faces)
