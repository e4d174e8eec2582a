"""A folder of scans: every failure is named, none stops the others, and the exit code tells whether all went well."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from scan_files import FAST_WORDS, box, gnrecon, torus, write_scan

from gnrecon.batch import run_batch
from gnrecon.errors import ExitCode, InputError, OutputError, UsageError
from gnrecon.export import verify_file
from gnrecon.schema import report_schema


def write_good(folder: Path) -> None:
    rng = np.random.default_rng(5)
    write_scan(folder / "ring.ply", *torus(1200, rng))
    np.savetxt(folder / "plate.xyz", np.hstack(box(1200, rng, (2.0, 1.0, 0.4))))


def summary(folder: Path) -> dict[str, dict[str, object]]:
    """What became of each scan, by its name."""
    found = json.loads((folder / "summary.json").read_text())
    assert found["failed"] == sum(scan["exit_code"] != 0 for scan in found["scans"])
    return {Path(scan["scan"]).name: scan for scan in found["scans"]}


def test_bad_files_are_named_and_stop_nothing(tmp_path: Path) -> None:
    scans, meshes = tmp_path / "scans", tmp_path / "new" / "meshes"
    scans.mkdir()
    write_good(scans)
    (scans / "torn.ply").write_bytes((scans / "ring.ply").read_bytes()[:5000])
    (scans / "void.ply").touch()
    (scans / "letter.txt").write_text("Dear reader,\nthis is a letter.\n")
    (scans / "README.md").write_text("No extension of a scan, so it is passed over.\n")
    done = gnrecon("batch", scans, "-o", meshes, *FAST_WORDS, "--format", "off", "--reports", "--pages")
    assert done.returncode == ExitCode.BATCH, done.stderr
    assert done.stdout == ""
    assert "2 of 5 scans reconstructed" in done.stderr
    written = [
        "plate.html",
        "plate.off",
        "plate.report.json",
        "ring.html",
        "ring.off",
        "ring.report.json",
        "summary.json",
    ]
    assert sorted(path.name for path in meshes.iterdir()) == written
    assert verify_file(meshes / "ring.off").genus == 1
    assert verify_file(meshes / "plate.off").genus == 0
    scan = summary(meshes)
    assert list(scan) == ["letter.txt", "plate.xyz", "ring.ply", "torn.ply", "void.ply"]
    assert scan["ring.ply"]["mesh"] == str(meshes / "ring.off")
    assert scan["ring.ply"]["message"] == ""
    report = json.loads(Path(str(scan["ring.ply"]["report"])).read_text())
    assert report["input"] == str(scans / "ring.ply")
    jsonschema.validate(report, report_schema())
    assert "of genus 1" in Path(str(scan["ring.ply"]["page"])).read_text(encoding="utf-8")
    for name, cause in (("torn.ply", "declares 1200"), ("void.ply", "is empty"), ("letter.txt", "neither numbers")):
        assert scan[name]["exit_code"] == ExitCode.INPUT
        assert (scan[name]["mesh"], scan[name]["report"], scan[name]["page"]) == ("", "", "")
        assert f"{scans / name}: " in str(scan[name]["message"])
        assert cause in str(scan[name]["message"])


def test_a_folder_of_good_scans_alone(tmp_path: Path) -> None:
    write_good(tmp_path)
    done = gnrecon("batch", tmp_path, "-o", tmp_path / "meshes", "--quiet", *FAST_WORDS)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert {(scan["exit_code"], scan["report"], scan["page"]) for scan in summary(tmp_path / "meshes").values()} == {
        (0, "", "")
    }
    assert verify_file(tmp_path / "meshes" / "ring.obj").genus == 1


def stand_in(path: Path, lines: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a shell script in the place of the interpreter that each scan is given; $4 is the scan and $6 its mesh."""
    path.write_text(f"#!/bin/sh\n{lines}\n")
    path.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(path))


def scans_of(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("name", ["SEGV", "KILL"])
def test_a_scan_killed_by_a_signal_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    scans = scans_of(tmp_path / "scans", "a.ply", "b.ply")
    script = f'echo noise >&2\ncase "$4" in *a.ply) kill -{name} $$;; esac\ntouch "$6"'
    stand_in(tmp_path / "python", script, monkeypatch)
    assert run_batch(scans, tmp_path / "meshes", "obj", [], quiet=True) == ExitCode.BATCH
    scan = summary(tmp_path / "meshes")
    assert scan["a.ply"]["message"] == f"Killed by SIG{name}."
    assert scan["a.ply"]["exit_code"] < 0
    assert (scan["b.ply"]["exit_code"], scan["b.ply"]["message"]) == (0, "")


def test_scans_receive_the_options_and_meshes_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = scans_of(tmp_path / "scans", "a.ply", "a.XYZ", "b.obj")
    stand_in(tmp_path / "python", 'echo "$@" > "$6"', monkeypatch)
    assert run_batch(scans, tmp_path, "stl", ["--seed", "7"], quiet=True) == ExitCode.OK
    # Two scans of one name do not fight for one mesh.
    for scan, mesh in (("a.ply", "a.ply.stl"), ("a.XYZ", "a.XYZ.stl"), ("b.obj", "b.stl")):
        words = (tmp_path / mesh).read_text()
        expected = f"-m gnrecon reconstruct {scans / scan} -o {tmp_path / mesh} --quiet --seed 7"
        assert words.strip() == expected


def test_an_interrupted_batch_keeps_the_account_of_what_it_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    scans = scans_of(tmp_path / "scans", "a.ply", "b.ply", "c.ply")
    script = 'case "$4" in *b.ply) echo "gnrecon: Interrupted; nothing was written." >&2; exit 130;; esac\ntouch "$6"'
    stand_in(tmp_path / "python", script, monkeypatch)
    assert run_batch(scans, tmp_path / "meshes", "obj", [], quiet=True) == ExitCode.INTERRUPTED
    scan = summary(tmp_path / "meshes")
    assert list(scan) == ["a.ply", "b.ply"]
    assert scan["b.ply"]["message"] == "Interrupted; nothing was written."
    told = tmp_path / "meshes" / "summary.json"
    assert capfd.readouterr().err == f"gnrecon: Interrupted; {told} tells what was done until then.\n"


def test_what_is_refused_before_any_scan(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"):
        run_batch(tmp_path / "missing", tmp_path / "meshes", "obj", [])
    (tmp_path / "README.md").touch()
    with pytest.raises(InputError, match="holds no scan"):
        run_batch(tmp_path, tmp_path / "meshes", "obj", [])
    (tmp_path / "a.obj").touch()
    with pytest.raises(UsageError, match="cannot be written as 'fbx'; use obj, ply"):
        run_batch(tmp_path, tmp_path / "meshes", "fbx", [])
    with pytest.raises(UsageError, match=r"a\.obj is a scan itself"):
        run_batch(tmp_path, tmp_path, "obj", [])
    with pytest.raises(OutputError, match="cannot be made"):
        run_batch(tmp_path, tmp_path / "README.md" / "meshes", "obj", [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["README.md", "a.obj"]


def test_a_missing_folder_has_its_exit_code(tmp_path: Path) -> None:
    done = gnrecon("batch", tmp_path / "missing", "-o", tmp_path / "meshes")
    assert done.returncode == ExitCode.INPUT
    assert done.stderr == f"gnrecon: There is no folder {tmp_path / 'missing'}.\n"
    assert not (tmp_path / "meshes").exists()
