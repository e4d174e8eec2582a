"""Every code block of the README and of docs/ runs.

The blocks of one document run in their order in one scratch copy of what they may name: `sample_data/`, and `scripts/`
with stand-ins that run this environment's gnrecon, so that no other environment is made. ``bash`` blocks run as one
script that ends at the first failure; ``python`` blocks each stand alone, with warnings as errors; other blocks are not
run. A block is left out only by a comment right above it that says why: ``<!-- not run: it needs two hours -->``.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from gnrecon.export import measure
from gnrecon.io import read_mesh

REPOSITORY = Path(__file__).resolve().parents[1]
DOCUMENTS = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("**/*.md"))]
LIMIT = 600.0  # seconds a block

RUNNERS = {
    "bash": ["bash", "-euo", "pipefail", "-c"],
    "python": [sys.executable, "-W", "error", "-c"],
}
FENCE = re.compile(
    r"^(?:<!-- *not run: *(?P<reason>.*?\S) *-->\s*\n)?(?P<indent> *)```(?P<language>\w*)[^\n]*\n"
    r"(?P<code>.*?)^(?P=indent)```[ ]*$",
    re.MULTILINE | re.DOTALL,
)

GNRECON = f"""#!/bin/sh
exec '{sys.executable}' -m gnrecon "$@"
"""
# Tests that run all tests would never end.
TEST = """#!/bin/sh
echo 'the tests are running already' >&2
"""


class Block(NamedTuple):
    """One fenced block: its language, code, line number, and why it is not run (empty: it is)."""

    language: str
    code: str
    line: int
    reason: str


def blocks(text: str) -> list[Block]:
    found = []
    for match in FENCE.finditer(text):
        indent = match["indent"]
        code = "".join(line.removeprefix(indent) for line in match["code"].splitlines(keepends=True))
        line = text.count("\n", 0, match.start("language")) + 1
        found.append(Block(match["language"], code, line, match["reason"] or ""))
    return found


def runnable() -> list[object]:
    return [
        pytest.param(document, block, id=f"{document.name}:{block.line}")
        for document in DOCUMENTS
        if document.is_file()
        for block in blocks(document.read_text())
        if block.language in RUNNERS
    ]


def make_scratch(folder: Path) -> Path:
    """Fill `folder` with the files that a document's commands may name."""
    shutil.copytree(REPOSITORY / "sample_data", folder / "sample_data")
    (folder / "scripts").mkdir()
    for name, text in (("gnrecon", GNRECON), ("test", TEST)):
        script = folder / "scripts" / name
        script.write_text(text)
        script.chmod(0o755)
    return folder


def run(block: Block, folder: Path, limit: float = LIMIT) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {
        "PATH": f"{folder / 'scripts'}{os.pathsep}{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(REPOSITORY),
    }
    command = [*RUNNERS[block.language], block.code]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=folder, env=environment, start_new_session=True, **pipes) as process:
        try:
            out, err = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            # With all that the block started, or its children would keep the pipes open.
            os.killpg(process.pid, signal.SIGKILL)
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, err)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Path]:
    """One folder for each document, because later blocks use what earlier ones wrote."""
    return {document: make_scratch(tmp_path_factory.mktemp(document.stem)) for document in DOCUMENTS}


@pytest.mark.parametrize(("document", "block"), runnable())
def test_block_runs(document: Path, block: Block, scratch: dict[Path, Path]) -> None:
    if block.reason:
        pytest.skip(block.reason)
    done = run(block, scratch[document])
    assert done.returncode == 0, f"{block.code}\n{done.stdout}\n{done.stderr}"


def test_the_first_command_makes_what_the_first_screen_shows(scratch: dict[Path, Path]) -> None:
    first, folder = blocks(DOCUMENTS[0].read_text())[0], scratch[DOCUMENTS[0]]
    mesh = folder / first.code.split()[-1]
    if not mesh.is_file():  # this test alone
        assert run(first, folder).returncode == 0
    truth = read_mesh(folder / "sample_data" / "bracket_reference.ply")
    found = measure(read_mesh(mesh), truth, samples=20_000)
    for title, value, room in (("mean distance", found.chamfer_mean, 1.2), ("largest distance", found.hausdorff, 1.5)):
        stated = re.search(rf"^\| {title}.*? \| ([0-9.]+) mm", DOCUMENTS[0].read_text(), re.MULTILINE)
        assert stated is not None
        # Another processor rounds differently; beyond that, scripts/make_first_screen.py makes the figures again.
        assert value < room * float(stated[1]), title


def test_there_is_a_readme_with_commands() -> None:
    assert any(block.language == "bash" and not block.reason for block in blocks(DOCUMENTS[0].read_text()))


def test_fences_are_recognised() -> None:
    text = (
        "a\n```bash\necho 1\n```\n<!-- not run: too long -->\n```python\nwait()\n```\n"
        "- b\n  ```bash\n  echo 2\n    echo 3\n  ```\n```\nplain\n```\n<!-- not run: -->\n```bash\nfalse\n```\n"
    )
    assert blocks(text) == [
        Block("bash", "echo 1\n", 2, ""),
        Block("python", "wait()\n", 6, "too long"),
        Block("bash", "echo 2\n  echo 3\n", 10, ""),
        Block("", "plain\n", 14, ""),
        # A comment without a reason excuses nothing.
        Block("bash", "false\n", 18, ""),
    ]


def test_a_block_fails_at_its_first_failing_command(tmp_path: Path) -> None:
    make_scratch(tmp_path)
    assert run(Block("bash", "false\ntrue\n", 1, ""), tmp_path).returncode != 0
    assert run(Block("bash", "false | true\n", 1, ""), tmp_path).returncode != 0
    assert run(Block("python", "import warnings; warnings.warn('x')", 1, ""), tmp_path).returncode != 0
    done = run(Block("bash", "ls sample_data/bracket_dense.ply && ./scripts/gnrecon --version\n", 1, ""), tmp_path)
    assert done.returncode == 0, done.stderr
    assert "gnrecon" in done.stdout


def test_a_block_that_does_not_end_is_ended(tmp_path: Path) -> None:
    start = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        run(Block("bash", "sleep 60 | cat\n", 1, ""), tmp_path, limit=0.5)
    assert time.monotonic() - start < 10
