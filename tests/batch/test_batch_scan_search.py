"""The scans that a batch finds, and the names of their outputs."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import fake_work
import pytest

from gnrecon.batch.execute import run_job
from gnrecon.batch.scan_search import FoundScan, ScanSearch, fill_template, find_scans, output_names
from gnrecon.runtime.errors import InputError, UsageError

TREE = ("a.ply", "b.xyz", "b.ply.gz", "notes.md", ".hidden.ply", "left/a.ply", "left/deep/c.e57", ".git/d.ply")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name in TREE:
        path = tmp_path / "scans" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path / "scans"


def names(found: list[FoundScan], root: Path) -> list[str]:
    return [one.scan.relative_to(root).as_posix() for one in found]


def test_folders(tree: Path) -> None:
    assert names(find_scans([str(tree)], [], ScanSearch()), tree) == ["a.ply", "b.ply.gz", "b.xyz"]
    deep = find_scans([str(tree)], [], ScanSearch(recursive=True))
    assert names(deep, tree) == ["a.ply", "b.ply.gz", "b.xyz", "left/a.ply", "left/deep/c.e57"]
    assert [str(one.folder) for one in deep] == [".", ".", ".", "left", "left/deep"]


def test_patterns_choose_among_the_files_of_folders(tree: Path) -> None:
    search = ScanSearch(("*.e57", "left/*.ply"), recursive=True)
    assert names(find_scans([str(tree)], [], search), tree) == ["left/a.ply", "left/deep/c.e57"]
    with pytest.raises(InputError, match=r"that match \*\.las; extensions read are"):
        find_scans([str(tree)], [], ScanSearch(("*.las",)))


def test_files_and_shell_patterns_each_once(tree: Path) -> None:
    found = find_scans([str(tree / "left/a.ply"), str(tree / "*/*.ply"), str(tree)], [], ScanSearch())
    assert names(found, tree) == ["left/a.ply", "a.ply", "b.ply.gz", "b.xyz"]
    assert names(find_scans([str(tree / "**/*.e57")], [], ScanSearch()), tree) == ["left/deep/c.e57"]


def test_a_list_is_relative_to_its_own_folder_and_may_name_what_is_gone(tree: Path) -> None:
    listing = tree / "list.txt"
    listing.write_text("# the good ones\n\nleft/a.ply\ngone.ply\nleft/deep\n")
    assert names(find_scans([], [listing], ScanSearch()), tree) == ["left/a.ply", "gone.ply", "left/deep/c.e57"]


def test_what_is_not_there_is_refused(tree: Path) -> None:
    with pytest.raises(InputError, match=r"There is no file or folder .*nowhere"):
        find_scans([str(tree), str(tree / "nowhere")], [], ScanSearch())
    with pytest.raises(InputError, match=r"The list .*none\.txt cannot be read: No such file"):
        find_scans([], [tree / "none.txt"], ScanSearch())
    (tree / "binary.txt").write_bytes(b"\xff\xfe\xff")
    with pytest.raises(InputError, match=r"The list .* cannot be read"):
        find_scans([], [tree / "binary.txt"], ScanSearch())


def test_meshes_of_the_batch_itself_are_no_scans(tmp_path: Path) -> None:
    one = fake_work.job(tmp_path, "good", "good")
    run_job(one, work=fake_work.WORK)
    (one.output / "scan.ply").touch()
    # The output folder within the folder of scans, around it, and the same.
    assert names(find_scans([str(tmp_path)], [], ScanSearch(recursive=True, output=one.output)), tmp_path) == [
        "scans/good.ply"
    ]
    assert len(find_scans([str(tmp_path / "scans")], [], ScanSearch(output=tmp_path))) == 1
    assert names(find_scans([str(one.output)], [], ScanSearch(output=one.output)), one.output) == ["scan.ply"]


def test_names_without_a_template() -> None:
    scans = ("s/a.ply", "s/b.xyz", "s/B.ply.gz", "s/v1.2.ply", "s/left/a.ply")
    found = [FoundScan(Path(scan), PurePosixPath(scan).parent.relative_to("s")) for scan in scans]
    assert output_names(found, None) == ["a", "b.xyz", "B.ply.gz", "v1.2", "left/a"]


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        ("{stem}", "a"),
        ("{name}", "a.ply.gz"),
        ("{folder}/{stem}", "left/a"),
        ("{parent}-{stem}", "left-a"),
        ("{index:04d}_{stem}", "0007_a"),
        ("./x/{stem}/mesh", "x/a/mesh"),
    ],
)
def test_templates(template: str, expected: str) -> None:
    assert fill_template(template, FoundScan(Path("s/left/a.ply.gz"), PurePosixPath("left")), 7) == expected


@pytest.mark.parametrize("template", ["{what}", "{stem", "{}", "{0}", "{index:zz}", "{stem.x}", "{stem[0]}"])
def test_templates_that_make_no_sense(template: str) -> None:
    with pytest.raises(UsageError, match=r"is not a template of names; the fields are \{stem\}"):
        fill_template(template, FoundScan(Path("a.ply")), 1)


@pytest.mark.parametrize("template", ["../{stem}", "/{stem}", "x/../../{stem}", "", ".gnrecon/{stem}"])
def test_names_stay_in_the_folder(template: str) -> None:
    with pytest.raises(UsageError, match="which is not a name within the folder"):
        fill_template(template, FoundScan(Path("a.ply")), 1)


def test_two_scans_of_one_name_are_refused() -> None:
    with pytest.raises(UsageError, match=r"x/a\.ply and y/A\.ply would both be called 'A'"):
        output_names([FoundScan(Path("x/a.ply")), FoundScan(Path("y/A.ply"))], "{stem}")
