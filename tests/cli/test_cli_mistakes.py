"""Typical mistakes at the prompt, each with the sentence and the exit code that answer it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import CommandLine, cube
from scan_files import torus, write_scan
from typer.main import get_command

from gnrecon.cli.app import command_line_app
from gnrecon.cli.command_classes import EVERYDAY
from gnrecon.cli.reconstruct_command import reconstruct_command
from gnrecon.io import write_mesh
from gnrecon.option_table import option_rows
from gnrecon.runtime.errors import ExitCode, suggestion
from gnrecon.version import __version__

USAGE, INPUT, OUTPUT = ExitCode.USAGE, ExitCode.INPUT, ExitCode.OUTPUT
MISTAKES = [
    # The command's name
    ("chek box.ply", USAGE, "There is no command and no file 'chek'; perhaps you mean 'check'."),
    ("rekonstruct scan.ply -o mesh.obj", USAGE, "no file 'rekonstruct'; perhaps you mean 'reconstruct'."),
    ("Convert box.ply box.obj", USAGE, "perhaps you mean 'convert'."),
    # The scan
    ("none.ply -o mesh.obj", INPUT, "There is no file none.ply."),
    ("none -o mesh.obj", INPUT, "There is no file none."),
    ("folder -o mesh.obj", INPUT, "folder: expected a file, but this is a folder or a device."),
    ("empty.ply -o mesh.obj", INPUT, "empty.ply: the file is empty."),
    ("notes.docx -o mesh.obj", INPUT, "notes.docx: the extension '.docx' is not supported; expected one of ply, pcd"),
    ("photo.ply -o mesh.obj", INPUT, "photo.ply: expected PLY data, but the file is a PNG image file."),
    ("flat.xyz -o mesh.obj", INPUT, "All points lie in one plane, so they enclose no volume."),
    ("- -o mesh.obj", USAGE, "Standard input has no extension: say with --format how to read it"),
    ("scan.ply -o mesh.obj --format plly", USAGE, "The format 'plly' is not supported; expected one of ply"),
    # A file of another kind than the command takes
    ("field.gnr -o mesh.obj", INPUT, "a fitted field, not a scan or a mesh: gnrecon mesh MODEL -o MESH meshes it."),
    ("info field.gnr", INPUT, "gnrecon mesh MODEL -o MESH meshes it."),
    ("check field.gnr", INPUT, "gnrecon mesh MODEL -o MESH meshes it."),
    ("mesh box.stl -o mesh.obj", INPUT, "is not a gnrecon model (.gnr): gnrecon check and gnrecon eval take"),
    ("mesh scan.ply -o mesh.obj", INPUT, "and gnrecon SCAN -o MESH takes a scan."),
    ("check scan.ply", INPUT, "scan.ply: expected a mesh, but the file holds 600 points and no faces."),
    # The output
    ("scan.ply", USAGE, "Missing option '-o' / '--output'."),
    ("scan.ply -o mesh.docx", USAGE, "A mesh cannot be written as '.docx'; use obj, ply, stl, off, glb, 3mf."),
    ("scan.ply -o nowhere/mesh.obj", OUTPUT, "nowhere/mesh.obj cannot be written: the folder"),
    ("scan.ply -o old.obj", OUTPUT, "old.obj exists already; choose another name or allow overwriting (--overwrite)."),
    ("scan.ply -o scan.ply --overwrite", USAGE, "scan.ply is named twice; an input or another output is never"),
    ("scan.ply -o mesh.obj --preview picture.jpg", USAGE, "a PNG picture, so it cannot be called picture.jpg."),
    ("scan.ply -o mesh.obj --report page.html", USAGE, "JSON, so it cannot be called page.html; --html writes a page."),
    ("scan.ply -o mesh.obj --report -", USAGE, "Results are written to files, so none of them can be called -."),
    ("scan.ply -o mesh.obj --save model.ply", USAGE, "saved as a .gnr file, so it cannot be called model.ply."),
    # An option's name
    ("scan.ply -o mesh.obj --fractoin 0.2", USAGE, "No such option: --fractoin; perhaps you mean '--fraction'."),
    ("scan.ply -o mesh.obj --resolutoin=64", USAGE, "perhaps you mean '--resolution'."),
    ("scan.ply -o mesh.obj --overwite", USAGE, "perhaps you mean '--overwrite'."),
    ("scan.ply -o mesh.obj --zzz 3", USAGE, "No such option: --zzz."),
    ("check box.ply --jsn", USAGE, "No such option: --jsn; perhaps you mean '--json'."),
    ("scan.ply -o mesh.obj --set sead=3", USAGE, "--set: there is no option 'sead'; perhaps you mean 'seed'."),
    ("scan.ply -o mesh.obj --set seed", USAGE, "--set expects NAME=VALUE, not 'seed'."),
    ("scan.ply -o mesh.obj --config step.toml", USAGE, "there is no option 'step'; perhaps you mean 'steps'."),
    ("scan.ply -o mesh.obj --config bad.toml", INPUT, "The configuration bad.toml is not TOML: Invalid value"),
    ("scan.ply -o mesh.obj --config none.toml", INPUT, "The configuration none.toml cannot be read: No such file"),
    # An option's value
    ("scan.ply -o mesh.obj --fraction 20", USAGE, "is 20, but must lie in (0, 1]; for 20 percent, give 0.2 or 20%."),
    ("scan.ply -o mesh.obj --fraction half", USAGE, "fraction must be a share such as 0.2 or 20%, not 'half'."),
    ("scan.ply -o mesh.obj --fraction 120%", USAGE, "The fraction of points is 120%, but must lie in (0, 1]."),
    ("scan.ply -o mesh.obj --holdout 100%", USAGE, "must lie between 0 and 1."),
    ("scan.ply -o mesh.obj --resolution fine", USAGE, "Invalid value for '--resolution'"),
    ("scan.ply -o mesh.obj --resolution 1e3", USAGE, "'1e3'"),
    ("scan.ply -o mesh.obj --feature-angle 20", USAGE, "angle needs a step that keeps edges; add --remesh, --simplify"),
    ("scan.ply -o mesh.obj --resolution 3", USAGE, "The resolution must be at least 16 cells, not 3."),
    ("scan.ply -o mesh.obj --quality hihg", USAGE, "The quality must be one of draft, normal, high, not 'hihg'."),
    ("scan.ply -o mesh.obj --subsample randm", USAGE, "'randm' is unknown; expected one of random, voxel"),
    ("scan.ply -o mesh.obj --crop 1,2,3", USAGE, "'1,2,3' is not a box: six numbers xmin,ymin,zmin,xmax,ymax,zmax"),
    ("scan.ply -o mesh.obj --units inch", USAGE, "unit must be one of um, mm, cm, m, km, in, ft, not 'inch'."),
    ("scan.ply -o mesh.obj --trim 2mm", USAGE, "'2mm' needs the file's own unit to be converted: add --units"),
    ("scan.ply -o mesh.obj --faces 0", USAGE, "The number of faces must be at least 4, not 0."),
    ("scan.ply -o mesh.obj --attributes colour", USAGE, "There is no attribute 'colour' to carry over"),
    ("scan.ply -o mesh.obj --device tpu", USAGE, "The device is 'tpu', but must be cpu or cuda."),
    # The other commands
    ("eval box.ply", USAGE, "Missing option '--reference'."),
    ("convert box.ply box.docx", USAGE, "A file cannot be written as '.docx'; use obj, ply"),
    ("batch folder -o out", INPUT, "There are no scans in folder"),
    ("batch scan.ply -o out --timeout soon", USAGE, "'soon' is not a time such as 90, 30s, 10m or 2h."),
    ("learn katenoid -o mesh.obj", USAGE, "There is no problem 'katenoid'; the problems are catenoid, enneper"),
]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the commands name."""
    folder = tmp_path_factory.mktemp("desk")
    write_scan(folder / "scan.ply", *torus(600, np.random.default_rng(3)))
    for name in ("box.ply", "box.stl"):
        write_mesh(cube(), folder / name)
    (folder / "folder").mkdir()
    texts = {
        "empty.ply": "",
        "notes.docx": "notes",
        "old.obj": "# mine\n",
        "field.gnr": "no field",
        "step.toml": "step = 3\n",
        "bad.toml": "step = \n",
        "flat.xyz": "\n".join(f"{x} {y} 0" for x in range(9) for y in range(9)),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / "photo.ply").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(99))
    return folder


@pytest.fixture
def command_line(capfd: pytest.CaptureFixture[str], desk: Path, monkeypatch: pytest.MonkeyPatch) -> CommandLine:
    monkeypatch.chdir(desk)
    return CommandLine(capfd)


@pytest.mark.parametrize(("line", "code", "sentence"), MISTAKES, ids=[line for line, *_ in MISTAKES])
def test_a_mistake_is_answered(command_line: CommandLine, desk: Path, line: str, code: ExitCode, sentence: str) -> None:
    before = {path: path.read_bytes() for path in desk.rglob("*") if path.is_file()}
    command_line.refuses(code, sentence, *line.split())
    assert {path: path.read_bytes() for path in desk.rglob("*") if path.is_file()} == before


def test_there_are_enough_of_them() -> None:
    assert len(MISTAKES) >= 30


def test_a_file_may_have_nearly_a_commands_name(
    command_line: CommandLine, desk: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "chek").write_bytes((desk / "empty.ply").read_bytes())
    command_line.refuses(INPUT, "chek: the file is empty.", "chek", "-o", "mesh.obj")


def test_no_words_print_the_help_and_nothing_else(command_line: CommandLine) -> None:
    done = command_line()
    assert (done.returncode, done.stderr) == (USAGE, "")
    assert "Usage: gnrecon" in done.stdout


@pytest.mark.parametrize("word", ["-V", "--version"])
def test_the_version(command_line: CommandLine, word: str) -> None:
    done = command_line(word)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"gnrecon {__version__}\n", "")


def test_percentages_are_shares(command_line: CommandLine) -> None:
    for share in ("50%", "0.5"):
        done = command_line("scan.ply", "-o", "mesh.obj", "--fraction", share, "--holdout", "10 %", "--dry-run")
        assert done.returncode == 0, done.stderr
        assert "300" in done.stdout + done.stderr or "270" in done.stdout + done.stderr


def flags(text: str) -> set[str]:
    """The options that a help text lists."""
    words = text.replace("│", " ").split()
    return {word for word in words if word.startswith("--") and word.islower()}


def test_help_lists_everyday_options_and_all_on_demand(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    everyday, everything = (command_line("scan.ply", word).stdout for word in ("--help", "--help-all"))
    listed = [line for line in everyday.splitlines() if line.startswith(("│ --", "│ *  --", "│    --"))]
    assert 10 <= len(listed) <= 16
    assert "--quality" in everyday
    assert "--solver" not in everyday
    rows = option_rows().values()
    assert {flag for row in rows for flag in row.flag.split("/")} <= flags(everything)
    plain = " ".join(everything.replace("│", " ").split())
    for row in rows:
        if row.default is not False:
            assert " ".join(row.described.split()[-3:]) in plain, row.name
            assert "default: " in row.described
    assert "[at least 16; default: 64 to 1,024, from the points' spacing and noise; 256 of a saved field]" in plain


FILES = [
    "output",
    "report",
    "preview",
    "save",
    "html",
    "config",
    "words",
    "save_config",
    "log",
    "reference",
    "lists",
    "reference_dir",
]


@pytest.mark.parametrize("name", EVERYDAY)
def test_help_of_each_command_is_short_and_its_help_all_complete(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    everyday, everything = (command_line(name, word).stdout for word in ("--help", "--help-all"))
    parameters = {parameter.name: parameter for parameter in get_command(command_line_app()).commands[name].params}
    assert set(EVERYDAY[name].split()) <= set(parameters)
    options = [one for one in parameters.values() if one.param_type_name == "option" and one.name != "help"]
    assert {flag for one in options for flag in (*one.opts, *one.secondary_opts) if flag[:2] == "--"} <= flags(
        everything
    )
    listed = {flag for flag in flags(everyday) if flag in {flag for one in options for flag in one.opts}}
    assert 10 <= len(listed) <= 16
    # Files that a run writes or reads have no default, flags are off by default, all else says what holds.
    valued = [one for one in options if not one.is_flag and one.name not in FILES]
    assert [one.name for one in valued if not re.search(r"\[.*default: .+\]$", one.help)] == []


def test_ranges_are_in_the_help() -> None:
    numbers = [row for row in option_rows().values() if {int, float} & set(row.types) and row.default is not False]
    assert [row.name for row in numbers if not row.limits] == []
    assert reconstruct_command.__doc__


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("gnrecon che", ["check"]),
        ("gnrecon scan.ply --fra", ["--fraction"]),
        ("gnrecon scan.ply -o mesh.obj --solv", ["--solver"]),
        ("gnrecon scan.ply --quality ", ["draft", "normal", "high"]),
        ("gnrecon mesh field.gnr --rem", ["--remesh"]),
        ("gnrecon batch folder --hold", ["--holdout"]),
        ("gnrecon sca", []),  # the shell then offers files
    ],
)
def test_shells_complete_lines(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch, line: str, expected: list[str]
) -> None:
    monkeypatch.setenv("_GNRECON_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    done = command_line()
    assert done.stdout.split() == expected, done.stderr


def test_a_shell_can_be_set_up() -> None:
    # The shell is named: what starts the tests need not be one.
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    environment["_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"] = "1"
    words = [sys.executable, "-m", "gnrecon", "--show-completion", "bash"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "complete -o default" in done.stdout
    assert "gnrecon" in done.stdout


@pytest.mark.parametrize(
    ("word", "end"),
    [
        ("solvr", "; perhaps you mean 'solver'"),
        ("SOLVER", "; perhaps you mean 'solver'"),
        ("q", "; the options are solver, seed"),
    ],
)
def test_the_likeliest_name(word: str, end: str) -> None:
    assert suggestion(word, ["solver", "seed"]) == end
    assert suggestion("q", ["solver"], kind="") == ""
