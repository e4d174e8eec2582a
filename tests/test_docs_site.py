"""The documentation builds as a site without a broken link, and its files say who, what and how to cite."""

from __future__ import annotations

import os
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import docs_site
import pytest

import gnrecon
from gnrecon.version import __version__

REPOSITORY = Path(__file__).resolve().parents[1]


def build(folder: Path, target: Path) -> subprocess.CompletedProcess[str]:
    """Build the site of a repository into a folder."""
    for needed in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(needed, reason="the site needs mkdocs-material and mkdocstrings")
    environment = os.environ | {"PYTHONPATH": str(folder), "NO_MKDOCS_2_WARNING": "1"}
    words = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(target)]
    return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def test_the_site_is_built(tmp_path: Path) -> None:
    done = build(REPOSITORY, tmp_path / "site")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "reference.html").read_text(encoding="utf-8")
    assert 'id="gnrecon.reconstruct"' in page
    assert "Several files are merged by the poses that they hold." in " ".join(page.split())


@pytest.mark.parametrize("link", ["no-such-page.md", "README.md#no-such-heading", "../setup.cfg"])
def test_a_broken_link_is_an_error(tmp_path: Path, link: str) -> None:
    yaml = pytest.importorskip("yaml", reason="the site needs mkdocs-material and mkdocstrings")
    settings = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"))
    for name in ("hooks", "nav", "plugins"):  # with which it would take longer
        del settings[name]
    (tmp_path / "mkdocs.yml").write_text(yaml.safe_dump(settings | {"plugins": []}))
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "README.md").write_text(f"# Title\n\n[gone]({link})\n")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert link.split("#")[-1] in done.stderr + done.stdout


@pytest.mark.parametrize(
    ("link", "page", "expected"),
    [
        ("[a](scans.md#units)", "docs/README.md", "[a](scans.md#units)"),
        ("[a](../CHANGELOG.md)", "docs/README.md", "[a](CHANGELOG.md)"),
        ("[a](../../CHANGELOG.md)", "docs/research/README.md", "[a](../CHANGELOG.md)"),
        ("[a](docs/scans.md)", "CHANGELOG.md", "[a](scans.md)"),
        ("[a](../README.md) b", "docs/README.md", "a b"),
        ("[`a`](../gnrecon/run.py)", "docs/README.md", "`a`"),
        ("[a](https://example.org/x)", "docs/README.md", "[a](https://example.org/x)"),
        ("[a](#below)", "docs/README.md", "[a](#below)"),
        ("[a](gone.md)", "docs/README.md", "[a](gone.md)"),
    ],
)
def test_links_stay_within_the_site(link: str, page: str, expected: str) -> None:
    assert docs_site.inside(link, page) == expected


def test_the_reference_has_every_public_name() -> None:
    listed = [line.rpartition(".")[2] for line in docs_site.reference().splitlines() if line.startswith(":::")]
    assert sorted([*listed, "__version__"]) == sorted(gnrecon.__all__)
    assert "::: gnrecon.fit.fit_field.fit" in docs_site.reference()


def test_the_project_says_what_it_is() -> None:
    setup = ConfigParser()
    setup.read(REPOSITORY / "setup.cfg")
    classifiers = setup["metadata"]["classifiers"]
    for part in ("Operating System :: POSIX :: Linux", "Python :: 3.11", "Topic :: Scientific/Engineering"):
        assert part in classifiers
    assert "point cloud" in setup["metadata"]["keywords"]
    citation = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {__version__}\n" in citation
    assert "arXiv:2602.00099" in citation


def test_what_contributors_read_names_files_that_exist() -> None:
    page = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    words = [word.strip("`,.;:()") for word in page.split()]
    named = [
        word for word in words if word.startswith(("gnrecon/", "scripts/", "tests/", "docs/")) and "NAME" not in word
    ]
    assert len(named) > 8
    assert [name for name in named if not (REPOSITORY / name).exists()] == []
