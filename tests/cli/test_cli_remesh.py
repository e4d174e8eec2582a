"""`--save` keeps the fitted field beside the mesh, and `gnrecon mesh` meshes it again."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import CommandLine
from scan_files import FAST_WORDS, TORUS_VOLUME, gnrecon, torus, write_scan
from scipy.spatial import cKDTree

from gnrecon.export import quality, verify_file
from gnrecon.fit import NeuralSDF
from gnrecon.io import read_mesh
from gnrecon.runtime.errors import ExitCode


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A torus as a scan, a mesh without attributes and a model."""
    folder = tmp_path_factory.mktemp("model")
    scan = write_scan(folder / "ring.ply", *torus(1200, np.random.default_rng(3)))
    files = ("-o", folder / "ring.obj", "--save", folder / "ring.gnr", "--attributes", "none")
    done = gnrecon(scan, *files, *FAST_WORDS)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def model(folder: Path) -> Path:
    return folder / "ring.gnr"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_nothing_but_what_was_asked_for_is_written(folder: Path) -> None:
    assert names(folder) == ["ring.gnr", "ring.obj", "ring.ply"]
    sdf = NeuralSDF.load(folder / "ring.gnr")
    assert len(sdf.data) == 1200
    assert np.abs(sdf.sdf(sdf.data)).max() < 0.05


def test_the_same_resolution_gives_the_same_bytes(model: Path, folder: Path, tmp_path: Path) -> None:
    done = gnrecon("mesh", model, "-o", tmp_path / "again.obj", "--resolution", 48, "--attributes", "none")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "again.obj").read_bytes() == (folder / "ring.obj").read_bytes()
    assert done.stdout == ""
    assert "genus 1, closed and manifold" in done.stderr


def test_a_finer_mesh_of_the_same_field(model: Path, folder: Path, tmp_path: Path, command: CommandLine) -> None:
    words = ("mesh", model, "-o", tmp_path / "fine.ply", "--resolution", 80, "--quiet")
    done = command(*words)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    facts = verify_file(tmp_path / "fine.ply")
    assert (facts.components, facts.genus) == (1, 1)
    assert facts.volume == pytest.approx(TORUS_VOLUME, rel=0.02)
    assert facts.faces > 2 * len(read_mesh(folder / "ring.obj").faces)


def test_edges_and_errors_may_be_asked_for_with_units(model: Path, tmp_path: Path, command: CommandLine) -> None:
    words = ("mesh", model, "--units", "cm", "-o")
    coarse = command(*words, tmp_path / "coarse.ply", "--edge-length", "1mm")
    assert coarse.returncode == 0, coarse.stderr
    assert "cells along the box: the mean edge is 0." in coarse.stderr
    mesh = read_mesh(tmp_path / "coarse.ply")
    sides = mesh.corners - np.roll(mesh.corners, -1, axis=1)
    assert np.linalg.norm(sides, axis=2).mean() == pytest.approx(0.1, rel=0.1)
    fine = command(*words, tmp_path / "fine.ply", "--edge-length", "1mm", "--max-error", "0.02mm")
    assert fine.returncode == 0, fine.stderr
    assert "99.9 % of face centres and edge midpoints lie within 0.0" in fine.stderr
    assert len(read_mesh(tmp_path / "fine.ply").faces) > 2 * len(mesh.faces)
    both = command(*words, tmp_path / "none.ply", "--edge-length", "1mm", "--resolution", 64)
    assert both.returncode == ExitCode.USAGE
    assert "only one of the two" in both.stderr


def test_vertices_carry_their_distance_and_curvature(model: Path, tmp_path: Path, command: CommandLine) -> None:
    words = ("mesh", model, "--resolution", 32, "--quiet", "-o")
    assert command(*words, tmp_path / "a.ply", "--curvature").returncode == 0
    mesh = read_mesh(tmp_path / "a.ply")
    assert set(mesh.attributes) == {"distance", "mean_curvature", "gauss_curvature"}
    data = NeuralSDF.load(model).data
    nearest = np.linalg.norm(mesh.vertices[::50, None] - data[None], axis=2).min(axis=1)
    assert np.allclose(mesh.attributes["distance"][::50], nearest)
    # Outermost, a torus is curved as its tube and as its own circle, innermost as its tube and against its circle.
    ring = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    assert np.median(mesh.attributes["gauss_curvature"][ring > 1.25]) > 0
    assert np.median(mesh.attributes["gauss_curvature"][ring < 0.75]) < 0
    assert command(*words, tmp_path / "b.ply", "--attributes", "none").returncode == 0
    assert read_mesh(tmp_path / "b.ply").attributes == {}
    words = (*words[:-2], "-o")
    assert "cannot hold distance" not in command(*words, tmp_path / "a.obj").stderr
    assert "cannot hold distance" in command(*words, tmp_path / "b.obj", "--attributes", "distance").stderr
    assert command(*words, tmp_path / "c.ply", "--offset", "0.1").returncode == 0
    assert read_mesh(tmp_path / "c.ply").attributes == {}


def test_a_device_that_is_not_there_is_refused(model: Path, tmp_path: Path, command: CommandLine) -> None:
    done = command("mesh", model, "-o", tmp_path / "a.ply", "--device", "abacus")
    assert done.returncode == ExitCode.USAGE
    assert "device is 'abacus', but must be cpu or cuda" in done.stderr
    if not torch.cuda.is_available():
        done = command("mesh", model, "-o", tmp_path / "a.ply", "--device", "cuda")
        assert done.returncode == ExitCode.USAGE
        assert "torch finds no CUDA GPU" in done.stderr
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA GPU")
def test_a_gpu_makes_the_same_surface(model: Path, tmp_path: Path, command: CommandLine) -> None:
    for device in ("cpu", "cuda"):
        words = ("mesh", model, "-o", tmp_path / f"{device}.ply", "--resolution", 48, "--device", device)
        done = command(*words)
        assert done.returncode == 0, done.stderr
    ours, theirs = (read_mesh(tmp_path / f"{device}.ply") for device in ("cpu", "cuda"))
    gaps, _ = cKDTree(theirs.vertices).query(ours.vertices)
    assert np.median(gaps) < 1e-6


def test_faces_of_a_wanted_size_or_number(model: Path, tmp_path: Path, command: CommandLine) -> None:
    words = ("mesh", model, "--resolution", 48, "-o")
    assert "Remeshed to edges of 0.1: " in command(*words, tmp_path / "even.ply", "--remesh", "0.1").stderr
    even = verify_file(tmp_path / "even.ply")
    assert even.genus == 1
    assert quality(read_mesh(tmp_path / "even.ply")).edge_length["mean"] == pytest.approx(0.1, rel=0.05)
    assert "distance" in read_mesh(tmp_path / "even.ply").attributes
    done = command(*words, tmp_path / "few.ply", "--faces", "400")
    assert (done.returncode, verify_file(tmp_path / "few.ply").faces) == (0, 400)
    done = command(*words, tmp_path / "within.ply", "--simplify", "0.02")
    said = re.search(r"Simplified to within 0.02: (\d+) faces became (\d+)", done.stderr)
    assert said is not None
    assert int(said[2]) == verify_file(tmp_path / "within.ply").faces < 0.9 * int(said[1])


def test_an_offset_is_measured_from_the_whole_surface_and_refined_itself(
    model: Path, tmp_path: Path, command: CommandLine
) -> None:
    words = ("mesh", model, "--resolution", 48, "--offset", "0.05", "-o")
    done = command(*words, tmp_path / "few.ply", "--faces", "600")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Decimated to 600 faces") == 1
    facts = verify_file(tmp_path / "few.ply")
    assert (facts.faces, facts.genus) == (600, 1)
    assert facts.volume == pytest.approx(2 * np.pi**2 * 0.35**2, rel=0.06)


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb"])
def test_offset_shell_and_crop_at_once(model: Path, tmp_path: Path, command: CommandLine, suffix: str) -> None:
    shape = ("--offset", "-20mm", "--units", "m", "--shell", "0.1", "--crop", "-2,-2,-2,2,2,0")
    target = tmp_path / f"bowl.{suffix}"
    done = command("mesh", model, "-o", target, "--resolution", 48, *shape)
    assert done.returncode == 0, done.stderr
    assert "offset by -0.02 lies 0.0" in done.stderr
    assert "offset by -0.12 lies 0.1" in done.stderr
    facts = verify_file(target)
    assert facts.components == 1
    # Half a torus of tube 0.28 without one of tube 0.18.
    assert facts.volume == pytest.approx(np.pi**2 * (0.28**2 - 0.18**2), rel=0.03)
    assert read_mesh(target).vertices[:, 2].max() == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--offset", "2mm"), "needs the file's own unit"),
        (("--offset", "much"), "'much' is not a length"),
        (("--offset", "1", "--units", "parsec"), "must be one of um, mm"),
        (("--shell", "0"), "thickness of a shell must be positive"),
        (("--shell", "-1"), "thickness of a shell must be positive"),
        (("--shell", "3"), "leaves nothing"),
        (("--crop", "0,0,0,1,1"), "six numbers"),
        (("--crop", "1,1,1,0,0,0"), "lower corner must come first"),
        (("--crop", "8,8,8,9,9,9"), "crop lies outside of the model"),
        (("--resolution", "3"), "at least 16 cells"),
        (("--attributes", "colors"), "no attribute 'colors'"),
        (("--threads", "0"), "threads must be positive"),
        (("--remesh", "-1"), "edge length to remesh to must be positive"),
        (("--adaptive",), "add --remesh"),
        (("--simplify", "0"), "tolerance to simplify to must be positive"),
        (("--faces", "3"), "number of faces must be at least 4"),
        (("--remesh", "1e-9"), "give --remesh at least"),
        (("--max-error", "1e-12"), "give --max-error at least"),
        (("--offset", "1e300"), "is out of range"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_usage(model: Path, tmp_path: Path, command: CommandLine, words: tuple[str, ...], sentence: str) -> None:
    coarse = () if "--resolution" in words else ("--resolution", "24")
    command.refuses(ExitCode.USAGE, sentence, "mesh", model, "-o", tmp_path / "m.ply", *words, *coarse, "--quiet")
    assert names(tmp_path) == []


def test_files_that_are_no_models(model: Path, folder: Path, tmp_path: Path, command: CommandLine) -> None:
    out = tmp_path / "out"
    out.mkdir()
    target = ("-o", out / "mesh.ply")
    command.refuses(ExitCode.INPUT, "There is no file", "mesh", tmp_path / "missing.gnr", *target)
    command.refuses(ExitCode.INPUT, "is not a gnrecon model", "mesh", folder / "ring.ply", *target)
    torn = tmp_path / "torn.gnr"
    torn.write_bytes(model.read_bytes()[:-100])
    command.refuses(ExitCode.INPUT, "is not a gnrecon model", "mesh", torn, *target)
    command.refuses(ExitCode.INPUT, "no file", "mesh", tmp_path, *target)
    assert names(out) == []


def test_targets_that_cannot_be_written(model: Path, tmp_path: Path, command: CommandLine) -> None:
    (tmp_path / "taken.ply").write_text("somebody's work")
    words = ("--resolution", "24", "--quiet")
    command.refuses(ExitCode.OUTPUT, "exists already", "mesh", model, "-o", tmp_path / "taken.ply", *words)
    command.refuses(ExitCode.OUTPUT, "does not exist", "mesh", model, "-o", tmp_path / "no" / "mesh.ply", *words)
    command.refuses(ExitCode.USAGE, "cannot be written as '.docx'", "mesh", model, "-o", tmp_path / "a.docx", *words)
    copy = tmp_path / "model.obj"
    shutil.copy(model, copy)
    command.refuses(ExitCode.USAGE, "named twice", "mesh", copy, "-o", copy, "--overwrite", *words)
    assert (tmp_path / "taken.ply").read_text() == "somebody's work"
    assert copy.read_bytes() == model.read_bytes()
    assert command("mesh", model, "-o", tmp_path / "taken.ply", "--overwrite", *words).returncode == 0
    verify_file(tmp_path / "taken.ply")


def test_a_model_is_saved_with_the_mesh_or_not_at_all(folder: Path, tmp_path: Path, command: CommandLine) -> None:
    scan = folder / "ring.ply"
    words = (scan, "-o", tmp_path / "mesh.obj", "--save")
    command.refuses(ExitCode.USAGE, "saved as a .gnr file", *words, tmp_path / "model.ply")
    command.refuses(ExitCode.OUTPUT, "does not exist", *words, tmp_path / "no" / "model.gnr")
    (tmp_path / "taken.gnr").write_text("somebody's work")
    command.refuses(ExitCode.OUTPUT, "exists already", *words, tmp_path / "taken.gnr")
    assert names(tmp_path) == ["taken.gnr"]
    assert (tmp_path / "taken.gnr").read_text() == "somebody's work"


def test_a_mesh_that_fails_leaves_no_model(
    folder: Path, tmp_path: Path, command: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, bordered: bool) -> None:
        del bordered
        raise RuntimeError(f"cannot read {path.suffix} back")

    monkeypatch.setattr("gnrecon.pipeline.verify_file", refuse)
    files = ("-o", tmp_path / "mesh.obj", "--save", tmp_path / "model.gnr")
    command.refuses(ExitCode.UNFORESEEN, "cannot read .obj back", folder / "ring.ply", *files, *FAST_WORDS, "--quiet")
    assert names(tmp_path) == []
