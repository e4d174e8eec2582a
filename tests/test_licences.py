"""The list of licences names every package that is required, and gnrecon works without the one under the GPL."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gnrecon.export import examine
from gnrecon.export.boolean import to_meshlab
from gnrecon.export.repair import repair
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import to_pymeshlab
from gnrecon.runtime.errors import MeshError, UsageError

REPOSITORY = Path(__file__).resolve().parents[1]


def test_the_list_names_what_setup_cfg_requires() -> None:
    script = "import make_licences as made; print(*made.required()); print(made.licence('numpy'))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=REPOSITORY / "scripts"
    )
    names, licence = done.stdout.splitlines()
    page = (REPOSITORY / "docs" / "licences.md").read_text(encoding="utf-8")
    assert {"numpy", "pymeshlab", "distributed", "pye57"} <= set(names.split())
    assert [name for name in names.split() if f"\n| {name} | " not in page] == []
    assert "BSD" in licence


def test_without_pymeshlab(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    whole = Mesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    assert examine(whole).self_intersecting_faces is None
    assert repair(whole)[1] == []
    for convert in (to_meshlab, to_pymeshlab):
        with pytest.raises(UsageError, match="needs the package pymeshlab"):
            convert(whole)
    with pytest.raises(MeshError, match="pymeshlab, which is not installed"):
        repair(Mesh(corners, whole.faces[:3]))


def looked_up(name: str, flaws: list[str], skipped: bool) -> dict[str, object]:
    if skipped:
        return {"name": name, "skip_reason": "not found on PyPI"}
    return {"name": name, "version": "1.0", "vulns": [{"id": one, "fix_versions": ["1.1"]} for one in flaws]}


@pytest.mark.parametrize(
    ("packages", "code", "lines"),
    [
        ([("a", [], False), ("b", [], False)], 0, ["2 of the 2 packages that gnrecon requires were looked up."]),
        ([("a", [], False), ("b", [], True)], 2, ["1 of the 2 packages that gnrecon requires were looked up. Not: b."]),
        ([("a", ["X-1"], False), ("b", [], False)], 1, ["a 1.0: X-1, mended in ['1.1']", "2 of the 2 packages that"]),
    ],
)
def test_what_was_not_looked_up_is_not_called_sound(
    monkeypatch: pytest.MonkeyPatch, packages: list[tuple[str, list[str], bool]], code: int, lines: list[str]
) -> None:
    monkeypatch.syspath_prepend(str(REPOSITORY / "scripts"))
    audit = importlib.import_module("audit")
    found = audit.audited({"dependencies": [looked_up(*package) for package in packages]}, {"a", "b"})
    assert found[0] == code
    assert [line.startswith(start) for line, start in zip(found[1], lines, strict=True)] == [True] * len(lines)


def test_no_vulnerability_is_known() -> None:
    pytest.importorskip("pip_audit", reason="pip-audit is not installed")
    done = subprocess.run(
        [sys.executable, "scripts/audit.py"], capture_output=True, text=True, check=False, cwd=REPOSITORY, timeout=300
    )
    if done.returncode == 2:
        pytest.skip("packages could not be looked up: " + (done.stdout + done.stderr)[-300:])
    assert done.returncode == 0, done.stdout
