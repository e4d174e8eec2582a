"""The command line as a user meets it: exit codes, one sentence for each failure, files that are whole or absent."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import CommandLine
from made_shapes import sphere
from markupsafe import escape
from scan_files import FAST_WORDS, TORUS_VOLUME, start, torus, wait_for, write_scan

from gnrecon.export import mesh_field, verify_file
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import read_mesh
from gnrecon.io.format_registry import WRITERS
from gnrecon.runtime.errors import ExitCode
from gnrecon.version import __version__

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A torus of 1,200 points in a file."""
    return write_scan(tmp_path_factory.mktemp("scans") / "ring.ply", *torus(1200, np.random.default_rng(3)))


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An empty folder for results."""
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


def names(folder: Path) -> list[str]:
    """All files, hidden ones too."""
    return sorted(path.name for path in folder.iterdir())


def assert_refused(done: subprocess.CompletedProcess[str], code: ExitCode, words: str) -> None:
    """One sentence on stderr that holds `words`, nothing on stdout."""
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("gnrecon: ")
    assert done.stderr.count("\n") == 1
    assert done.stderr.endswith("\n")
    assert words in done.stderr


@pytest.fixture
def here(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    """The command line within this process, where no signal and no fault of a stage needs a process of its own."""
    return CommandLine(capfd)


def rows(points: np.ndarray) -> str:
    return "\n".join(" ".join(map(str, row)) for row in points)


SQUARE = np.random.default_rng(0).uniform(size=(50, 3)) * [1, 1, 0]
BAD_SCANS = {
    "two.xyz": ("0 0 0\n1 1 1\n", "Only 2 of 2 points are usable"),
    "nan.xyz": ("nan nan nan\n" * 50, "Only 0 of 50 points are usable"),
    "flat.xyz": (rows(SQUARE), "in one plane"),
    "line.xyz": (rows(SQUARE * [1, 0, 0]), "on one line"),
    "one_place.xyz": ("1 2 3\n" * 50, "Only 1 of 50"),
    "empty.ply": ("", "is empty"),
    "picture.ply": (PNG + bytes(100), "PNG image"),
    "scan.docx": ("0 0 0\n", "extension '.docx' is not supported"),
}


@pytest.mark.parametrize("name", BAD_SCANS)
def test_scans_that_cannot_be_reconstructed(tmp_path: Path, out: Path, here: CommandLine, name: str) -> None:
    content, words = BAD_SCANS[name]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    assert_refused(here(tmp_path / name, "-o", out / "mesh.obj", "--report", out / "r.json"), ExitCode.INPUT, words)
    assert names(out) == []


def test_scans_that_are_missing_or_torn(tmp_path: Path, out: Path, scan: Path, here: CommandLine) -> None:
    missing = tmp_path / "missing.ply"
    assert_refused(here(missing, "-o", out / "a.obj"), ExitCode.INPUT, f"There is no file {missing}.")
    torn = tmp_path / "torn.ply"
    torn.write_bytes(scan.read_bytes()[:-10])
    assert_refused(here(torn, "-o", out / "a.obj"), ExitCode.INPUT, "declares 1200 vertex rows")
    assert_refused(
        here(scan, "-o", out / "a.obj", "--reference", missing), ExitCode.INPUT, f"There is no file {missing}."
    )
    assert names(out) == []


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("-o", "{out}/mesh.docx"), "cannot be written as '.docx'; use obj, ply"),
        (("-o", "{out}/mesh"), "a file without an extension"),
        ((), "Missing option '-o'"),
        (("-o", "{out}/mesh.obj", "--fraction", "1.5"), "fraction of points is 1.5"),
        (("-o", "{out}/mesh.obj", "--fraction", "half"), "fraction must be a share such as 0.2 or 20%, not 'half'"),
        (("-o", "{out}/mesh.obj", "--resolution", "3"), "at least 16 cells, not 3"),
        (
            ("-o", "{out}/mesh.obj", "--widths", "32;32"),
            "widths must be a list of whole numbers such as 2000 or 32,32,32, not '32;32'",
        ),
        (("-o", "{out}/mesh.obj", "--smoothness", "1"), "No such option: --smoothness"),
        (("-o", "{out}/mesh.obj", "--preview", "{out}/picture.jpg"), "picture.jpg"),
        (("-o", "{out}/mesh.obj", "--html", "{out}/page.pdf"), "page.pdf"),
        (("-o", "{out}/mesh.obj", "--html", "{out}/mesh.obj"), "so it cannot be called"),
        (("-o", "{out}/mesh.obj", "--report", "{out}/mesh.obj"), "named twice"),
        (("-o", "{scan}", "--overwrite"), "named twice"),
    ],
    ids=lambda value: " ".join(value[2:] or value) if isinstance(value, tuple) else "",
)
def test_usage(out: Path, scan: Path, here: CommandLine, words: tuple[str, ...], sentence: str) -> None:
    before = scan.read_bytes()
    assert_refused(here(scan, *(w.format(out=out, scan=scan) for w in words)), ExitCode.USAGE, sentence)
    assert names(out) == []
    assert scan.read_bytes() == before


@pytest.mark.parametrize("linked", [False, True])
def test_a_scan_that_a_conf_names_is_never_written(out: Path, scan: Path, here: CommandLine, linked: bool) -> None:
    part, poses = out / "part.ply", out / "poses.txt"
    part.write_bytes(scan.read_bytes())
    poses.write_text("bmesh part.ply 0 0 0 0 0 0 1\n")
    target = out / "link.ply" if linked else part
    if linked:
        target.symlink_to(part)
    before = names(out)
    done = here(poses, "--format", "conf", "-o", target, "--overwrite")
    assert_refused(done, ExitCode.USAGE, "an input or another output is never overwritten")
    done = here(poses, "--format", "conf", "-o", out / "mesh.obj", "--report", target, "--overwrite")
    assert_refused(done, ExitCode.USAGE, "an input or another output is never overwritten")
    assert names(out) == before
    assert part.read_bytes() == scan.read_bytes()


def test_a_buffer_that_a_gltf_names_is_never_written(out: Path, here: CommandLine) -> None:
    scene, buffer = out / "scene.gltf", out / "points.ply"
    buffer.write_bytes(np.zeros((3, 3), np.float32).tobytes())
    scene.write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": "points.ply", "byteLength": 36}]}))
    for words in (("convert", scene, buffer), (scene, "-o", buffer)):
        assert_refused(here(*words, "--overwrite"), ExitCode.USAGE, "an input or another output is never overwritten")
    assert buffer.read_bytes() == bytes(36)


def test_a_configuration_that_is_read_is_never_written(out: Path, scan: Path, here: CommandLine) -> None:
    config = out / "c.toml"
    config.write_text("seed = 3\n")
    words = (scan, "-o", out / "mesh.obj", "--config", config, "--save-config", config, "--overwrite")
    assert_refused(here(*words), ExitCode.USAGE, "an input or another output is never overwritten")
    assert_refused(here(*words[:5], "--log", config), ExitCode.USAGE, "is named twice")
    assert config.read_text() == "seed = 3\n"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there(out: Path, scan: Path, here: CommandLine) -> None:
    assert_refused(here(scan, "-o", out / "a.obj", "--device", "cuda"), ExitCode.USAGE, "no CUDA GPU")
    assert names(out) == []


def test_targets_that_cannot_be_written(out: Path, scan: Path, here: CommandLine) -> None:
    (out / "taken.obj").write_text("somebody's work")
    assert_refused(here(scan, "-o", out / "taken.obj"), ExitCode.OUTPUT, "--overwrite")
    done = here(scan, "-o", out / "mesh.obj", "--report", out / "taken.obj")
    assert_refused(done, ExitCode.OUTPUT, "taken.obj exists already")
    assert_refused(here(scan, "-o", out / "no" / "mesh.obj"), ExitCode.OUTPUT, "does not exist")
    assert names(out) == ["taken.obj"]
    assert (out / "taken.obj").read_text() == "somebody's work"


def assert_torus(path: Path) -> None:
    """The file holds a sound torus, for us and for trimesh."""
    import trimesh

    facts = verify_file(path)
    assert (facts.components, facts.genus) == (1, 1)
    assert facts.volume == pytest.approx(TORUS_VOLUME, rel=0.02)
    mesh = trimesh.load(path, force="mesh")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(facts.volume, rel=1e-5)


def test_a_trimmed_mesh_is_open_and_said_to_be(out: Path, tmp_path: Path, here: CommandLine) -> None:
    points, normals = sphere(2000, np.random.default_rng(3))
    half = points[:, 0] > 0
    scan = write_scan(tmp_path / "half.ply", points[half], normals[half])
    words = ("-o", out / "mesh.ply", "--report", out / "report.json", "--widths", "300", "--steps", "0")
    closed = here(scan, *words, "--resolution", "32")
    assert closed.returncode == 0, closed.stderr
    assert "of the surface is invented" in closed.stderr
    done = here(scan, *words, "--resolution", "32", "--trim", "3s", "--overwrite")
    assert done.returncode == 0, done.stderr
    assert "Cut off" in done.stderr
    assert "The mesh is open: an oriented edge-manifold with borders" in done.stderr
    assert "open, edge-manifold and oriented, area" in done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["mesh"]["guarantee"] == "oriented edge-manifold with borders"
    assert report["mesh"]["volume"] is None
    assert report["trim"]["distance"] == report["mesh"]["invented_beyond"]
    assert report["mesh"]["invented_area_share"] < 0.05
    checked = here("check", out / "mesh.ply")
    assert checked.returncode == ExitCode.MESH
    refused = here(scan, "-o", out / "none.ply", "--trim", "0")
    assert_refused(refused, ExitCode.USAGE, "not a positive distance")


def test_an_stl_at_map_coordinates_names_its_origin(out: Path, tmp_path: Path, here: CommandLine) -> None:
    points, normals = torus(1200, np.random.default_rng(3))
    place = np.array([500_000.25, 4_000_000.25, 100.25])
    scan = write_scan(tmp_path / "far.ply", points + place, normals)
    done = here(scan, "-o", out / "far.stl", "--report", out / "report.json", *FAST_WORDS)
    assert done.returncode == 0, done.stderr
    assert "relative to the origin 500000 4000000 100. The file's header states it" in done.stderr
    assert json.loads((out / "report.json").read_text())["origin"] == [500_000, 4_000_000, 100]
    assert (out / "far.stl").read_bytes().startswith(b"STL, origin 500000 4000000 100 ")
    facts = verify_file(out / "far.stl")
    assert facts.genus == 1
    assert facts.volume == pytest.approx(TORUS_VOLUME, rel=0.05)
    corners = read_mesh(out / "far.stl").vertices
    assert (corners.min(axis=0) + corners.max(axis=0)) / 2 == pytest.approx(place, rel=0, abs=0.05)


def test_a_mesh_with_report_picture_and_measurement(out: Path, scan: Path, here: CommandLine) -> None:
    from PIL import Image

    files = ("--report", out / "report.json", "--preview", out / "picture.png", "--html", out / "page.html")
    words = (scan, "-o", out / "mesh.ply", "--reference", scan, *files, *FAST_WORDS)
    done = here(*words)
    assert done.returncode == 0, done.stderr
    assert_torus(out / "mesh.ply")
    report = json.loads((out / "report.json").read_text())
    assert report["input"] == str(scan)
    assert report["command"] == shlex.join(["gnrecon", *map(str, words)])
    assert report["mesh"]["genus"] == 1
    assert "error" in [attribute["name"] for attribute in report["attributes"]]
    page = (out / "page.html").read_text(encoding="utf-8")
    for shown in ("of genus 1 in 1 component", 'data-to="error"', 'data-set="points"', escape(report["command"])):
        assert shown in page
    printed = dict(line.split()[:2] for line in done.stdout.splitlines())
    for name in ("chamfer_mean", "hausdorff", "f_score"):
        assert float(printed[name]) == pytest.approx(report["metrics"][name], rel=1e-4)
    assert 0 < report["metrics"]["chamfer_mean"] < 0.1
    with Image.open(out / "picture.png") as picture:
        assert picture.format == "PNG"
        assert picture.size == (1200, 960)
    assert "genus 1, closed and manifold" in done.stderr
    assert names(out) == ["mesh.ply", "page.html", "picture.png", "report.json"]


@pytest.mark.parametrize("suffix", ["obj", "off", "stl", "glb"])
def test_formats_written_quietly_over_older_files(out: Path, scan: Path, suffix: str, here: CommandLine) -> None:
    mesh = out / f"mesh.{suffix}"
    mesh.write_text("an older mesh")
    done = here("reconstruct", scan, "-o", mesh, "--overwrite", "--quiet", *FAST_WORDS)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert_torus(mesh)
    assert names(out) == [mesh.name]


@contextmanager
def started(*words: object, before: str = "") -> Iterator[subprocess.Popen[str]]:
    """A running command line that is gone afterwards, whatever happens."""
    process = start(*words, before=before)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    """The exit code, and what is left on stderr."""
    _, stderr = process.communicate(timeout=60)
    return process.returncode, stderr


def pause_at(place: str) -> str:
    """Code that makes a function of the pipeline say so and wait instead of doing anything."""
    say = "print('paused', file=sys.stderr, flush=True)"
    return f"import gnrecon.pipeline\n{place} = lambda *_, **__: ({say}, time.sleep(60))"


def test_an_interrupt_during_the_fit_keeps_the_best_mesh(out: Path, scan: Path) -> None:
    words = ("--widths", "300", "--steps", "5000", "--resolution", "48")
    with started(scan, "-o", out / "mesh.obj", "-v", "--report", out / "report.json", *words) as process:
        wait_for(process, "step")
        process.send_signal(signal.SIGINT)
        code, stderr = end(process)
    assert code == ExitCode.INTERRUPTED, stderr
    assert stderr.endswith(f"gnrecon: Interrupted; {out / 'mesh.obj'} is the mesh of the best field so far.\n")
    assert_torus(out / "mesh.obj")
    assert json.loads((out / "report.json").read_text())["fit"]["interrupted"]


@pytest.fixture
def ended_by(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, signal.Signals], None]]:
    """Make this process get a signal in place of a stage of the pipeline."""

    def end_at(stage: str, number: signal.Signals) -> None:
        def ended(*_: object, **__: object) -> None:
            signal.raise_signal(number)
            raise AssertionError(f"{number.name} does nothing")

        monkeypatch.setattr(f"gnrecon.pipeline.{stage}", ended)

    # Where the tests run in the background, SIGINT arrives ignored; under nohup, SIGHUP.
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGHUP)}
    yield end_at
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("stage", ["read_scans", "prepare"])
def test_an_interrupt_before_the_fit_writes_nothing(
    out: Path, scan: Path, here: CommandLine, ended_by: Callable[[str, signal.Signals], None], stage: str
) -> None:
    ended_by(stage, signal.SIGINT)
    done = here(scan, "-o", out / "mesh.obj")
    assert (done.returncode, done.stderr) == (ExitCode.INTERRUPTED, "gnrecon: Interrupted; nothing was written.\n")
    assert names(out) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_polite_end_while_writing_leaves_nothing(
    out: Path,
    scan: Path,
    here: CommandLine,
    ended_by: Callable[[str, signal.Signals], None],
    number: signal.Signals,
) -> None:
    ended_by("verify_file", number)
    done = here(scan, "-o", out / "mesh.obj", "--report", out / "report.json", *FAST_WORDS)
    assert done.returncode == ExitCode.INTERRUPTED, done.stderr
    assert names(out) == []


@pytest.mark.parametrize("place", ["fit", "verify_file"])
def test_a_kill_leaves_nothing_under_the_targets_name(out: Path, scan: Path, place: str) -> None:
    with started(scan, "-o", out / "mesh.obj", *FAST_WORDS, before=pause_at(f"gnrecon.pipeline.{place}")) as process:
        wait_for(process, "paused")
        process.kill()
        assert end(process)[0] == -signal.SIGKILL
    assert not (out / "mesh.obj").exists()


def torn_by_cutting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_field, "remove_handles", lambda mesh, *_, **__: (Mesh(mesh.vertices, mesh.faces[1:]), []))


def torn_by_writing(monkeypatch: pytest.MonkeyPatch) -> None:
    write = WRITERS[".obj"]
    monkeypatch.setitem(WRITERS, ".obj", lambda mesh, path: write(Mesh(mesh.vertices, mesh.faces[1:]), path))


@pytest.mark.parametrize("tear", [torn_by_cutting, torn_by_writing])
def test_an_open_mesh_is_not_written(
    out: Path,
    scan: Path,
    here: CommandLine,
    monkeypatch: pytest.MonkeyPatch,
    tear: Callable[[pytest.MonkeyPatch], None],
) -> None:
    tear(monkeypatch)
    done = here(scan, "-o", out / "mesh.obj", "--report", out / "report.json", *FAST_WORDS)
    assert done.returncode == ExitCode.MESH
    assert "is open: 3 edges have only one face." in done.stderr.splitlines()[-1]
    assert names(out) == []


def test_debug_shows_a_traceback(out: Path, scan: Path, here: CommandLine) -> None:
    done = here(scan, "-o", out / "mesh.obj", "--resolution", "3", "--debug")
    assert done.returncode == ExitCode.USAGE
    assert done.stderr.startswith("Traceback (most recent call last)")
    assert done.stderr.splitlines()[-1].startswith("gnrecon: The resolution must be")


def test_a_fault_of_our_own_still_ends_in_one_sentence(
    out: Path, scan: Path, here: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnrecon.pipeline.prepare", None)
    done = here(scan, "-o", out / "mesh.obj")
    assert done.returncode == ExitCode.UNFORESEEN
    assert done.stderr.count("\n") == 1
    assert "Unforeseen TypeError" in done.stderr
    assert "--debug" in done.stderr


def test_version_and_help(here: CommandLine) -> None:
    version = here("--version")
    assert (version.returncode, version.stdout, version.stderr) == (0, f"gnrecon {__version__}\n", "")
    top = here("--help")
    assert top.returncode == 0
    for word in ("reconstruct", "batch", "doctor", "Exit codes"):
        assert word in top.stdout
    details = here("reconstruct", "--help-all")
    assert details.returncode == 0
    for option in ("--output", "--fraction", "--widths", "--resolution", "--reference", "--overwrite", "--debug"):
        assert option in details.stdout


def test_the_command_line_starts_without_the_stages() -> None:
    code = "import sys, gnrecon.cli.app; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    rooms = {name.split(".")[1] for name in loaded if name.startswith("gnrecon.")}
    assert rooms == {"cli", "deprecated_paths", "option_table", "runtime", "version"}
    assert "numpy" not in loaded
    assert "scipy" not in loaded


def test_files_are_refused_before_the_libraries_of_a_fit_are_loaded(scan: Path, out: Path) -> None:
    (out / "there.ply").touch()
    code = (
        "import sys\n"
        "from gnrecon.cli.app import main\n"
        "try:\n    main(sys.argv[1:])\n"
        "except SystemExit as end:\n    print(end.code, *{'torch', 'scipy', 'open3d'} & set(sys.modules))\n"
    )
    for source, target, ends in (
        (scan, "there.ply", ExitCode.OUTPUT),
        (out / "none.ply", "new.ply", ExitCode.INPUT),
        (scan, "new.docx", ExitCode.USAGE),
    ):
        command = [sys.executable, "-c", code, str(source), "-o", str(out / target)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.stdout == f"{int(ends)}\n", done.stderr
    assert names(out) == ["there.ply"]


def test_a_scan_from_standard_input_makes_all_files(scan: Path, out: Path) -> None:
    command = [sys.executable, "-m", "gnrecon", "-", "--format", "ply", "-o", str(out / "a.ply"), *FAST_WORDS]
    command += ["--html", str(out / "a.html")]
    with scan.open("rb") as file:
        done = subprocess.run(command, stdin=file, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.OK, done.stderr
    assert names(out) == ["a.html", "a.ply"]


def test_standard_input_needs_a_format(here: CommandLine, out: Path) -> None:
    assert_refused(here("-", "-o", out / "a.ply"), ExitCode.USAGE, "say with --format how to read it")
