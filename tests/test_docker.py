"""The Dockerfile holds what an installation needs, and takes its system libraries from where everything else does."""

from __future__ import annotations

import configparser
import re
import shlex
from pathlib import Path

import pytest

from gnrecon.cli.system_packages import LIBRARIES

REPOSITORY = Path(__file__).resolve().parents[1]
TEXT = re.sub(r"\\\n\s*", "", (REPOSITORY / "Dockerfile").read_text())
STEPS = [tuple(line.split(maxsplit=1)) for line in TEXT.splitlines() if line.strip() and not line.startswith("#")]


def arguments(instruction: str) -> list[str]:
    return [rest for name, rest in STEPS if name == instruction]


def copied() -> list[str]:
    return [source for rest in arguments("COPY") for source in shlex.split(rest)[:-1]]


@pytest.mark.parametrize("source", copied())
def test_what_is_copied_exists_and_is_not_ignored(source: str) -> None:
    assert (REPOSITORY / source).exists()
    first, *kept = [
        line for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if not line.startswith(("#", "**/"))
    ]
    assert first == "*"
    assert f"!{Path(source).parts[0]}" in kept


def test_nothing_that_the_installation_reads_is_missing() -> None:
    settings = configparser.ConfigParser()
    settings.read(REPOSITORY / "setup.cfg")
    readme = settings["metadata"]["long_description"].removeprefix("file: ")
    needed = {"setup.cfg", "pyproject.toml", "gnrecon", readme, settings["metadata"]["license_files"]}
    assert needed <= set(copied())


def test_system_libraries_are_named_in_one_place() -> None:
    (install,) = (rest for rest in arguments("RUN") if "apt-get" in rest)
    assert "python -I /tmp/system_packages.py | xargs" in install
    assert "gnrecon/cli/system_packages.py /tmp/" in arguments("COPY")
    assert not [package for package in LIBRARIES.values() if package in TEXT]


def test_the_image_runs_the_command_line_and_not_as_root() -> None:
    assert arguments("ENTRYPOINT") == ['["gnrecon"]']
    assert arguments("USER") not in ([], ["root"], ["0"])
    assert "ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu" in TEXT
    assert any("${TORCH_INDEX}" in rest for rest in arguments("RUN"))
