"""The rules of who may import whom, read from the sources themselves."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import make_architecture
import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "gnrecon"
ARCHITECTURE = PACKAGE.parent / "docs" / "architecture.md"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# From the ground up; a room imports from lower rows and from itself, never from its neighbours in the row.
ROWS = [
    {"version", "deprecated_paths"},
    {"runtime"},
    {"geometry"},
    {"least_squares"},
    {"optim"},
    {"field"},
    {"residuals"},
    {"level_set"},
    {"fit", "ingest", "io"},
    {"export"},
    {"rendering"},
    {"option_table"},
    {"options", "shape_learning"},
    {"config", "report", "vertex_attributes"},
    {"solid"},
    {"pipeline"},
    {"run"},
    {"batch"},
    {"cli"},
    {"__main__", "__init__"},
]
HEIGHT = {room: height for height, row in enumerate(ROWS) for room in row}
HEAVY = {"open3d", "pymeshlab", "trimesh", "manifold3d", "skimage"}
HEAVY_ROOMS = {"io", "ingest", "export", "rendering", "runtime"}
# These know no geometry, and are tested on problems that are no shapes.
# Of the runtime, they use threads.
PURE_ROOMS = {"least_squares": {"least_squares", "runtime"}, "optim": {"least_squares", "optim"}}


class Import(NamedTuple):
    """One imported module, by its full name; `lazy` inside of a function or for the type checker alone."""

    module: str
    lazy: bool


def imports(source: Path) -> list[Import]:
    tree = ast.parse(source.read_text())
    return list(_walk(tree, package=".".join(source.relative_to(PACKAGE.parent).parent.parts), lazy=False))


def _walk(node: ast.AST, package: str, lazy: bool) -> Iterator[Import]:
    if isinstance(node, ast.Import):
        yield from (Import(alias.name, lazy) for alias in node.names)
    if isinstance(node, ast.ImportFrom):
        parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
        module = ".".join([*parents, *([node.module] if node.module else [])])
        # `from gnrecon import io` names a room as well as `from gnrecon.io import ...` does.
        names = [f"gnrecon.{alias.name}" for alias in node.names] if module == "gnrecon" else [module]
        yield from (Import(name, lazy) for name in names)
    deferred = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
    typing_only = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    for child in ast.iter_child_nodes(node):
        yield from _walk(child, package, lazy or deferred or typing_only)


def room(source: Path) -> str:
    """The first part of the path below the package: a folder, or a file without its extension."""
    return source.relative_to(PACKAGE).parts[0].removesuffix(".py")


def room_of(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "gnrecon" and len(parts) > 1 else None


def name_of(source: Path) -> str:
    return source.relative_to(PACKAGE).as_posix()


@pytest.mark.parametrize("source", SOURCES, ids=name_of)
def test_imports_point_down(source: Path) -> None:
    own = room(source)
    assert own in HEIGHT, f"give {own} a row in ROWS"
    for module, _ in imports(source):
        other = room_of(module)
        if other is None or other == own:
            continue
        assert other in HEIGHT, f"{name_of(source)} imports {module}, which has no row in ROWS"
        assert HEIGHT[other] < HEIGHT[own], f"{name_of(source)} imports {module}, which is not below it"


@pytest.mark.parametrize("source", SOURCES, ids=name_of)
def test_heavy_libraries_are_imported_lazily_at_the_edges_alone(source: Path) -> None:
    for module, lazy in imports(source):
        if module.split(".")[0] in HEAVY:
            assert room(source) in HEAVY_ROOMS, f"{name_of(source)} imports {module}"
            assert lazy, f"{name_of(source)} imports {module} when it is imported itself"


@pytest.mark.parametrize("source", [s for s in SOURCES if room(s) in PURE_ROOMS], ids=name_of)
def test_numerics_import_torch_alone(source: Path) -> None:
    for module, _ in imports(source):
        known = {"torch", "numpy", *sys.stdlib_module_names}
        assert module.split(".")[0] in known or room_of(module) in PURE_ROOMS[room(source)], (
            f"{name_of(source)} imports {module}"
        )


def test_the_doctor_needs_little() -> None:
    for module, lazy in imports(PACKAGE / "cli" / "doctor.py"):
        known = {"rich", *sys.stdlib_module_names}
        assert lazy or module.split(".")[0] in known or module == "gnrecon.cli.system_packages", module


def test_the_first_set_up_can_ask_for_packages_without_any() -> None:
    roots = {module.split(".")[0] for module, _ in imports(PACKAGE / "cli" / "system_packages.py")}
    assert roots <= set(sys.stdlib_module_names)


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("import open3d.core", [Import("open3d.core", False)]),
        ("def f():\n    from trimesh import Trimesh", [Import("trimesh", True)]),
        ("if TYPE_CHECKING:\n    import trimesh", [Import("trimesh", True)]),
        ("from gnrecon import io", [Import("gnrecon.io", False)]),
        ("from .ply import read_ply", [Import("gnrecon.io.ply", False)]),
        ("from ..export import repair", [Import("gnrecon.export", False)]),
        ("from .. import export", [Import("gnrecon.export", False)]),
    ],
)
def test_imports_are_recognised(code: str, expected: list[Import]) -> None:
    assert list(_walk(ast.parse(code), package="gnrecon.io", lazy=False)) == expected


def test_the_architecture_lists_every_file() -> None:
    page = ARCHITECTURE.read_text()
    assert make_architecture.updated(page) == page, "run scripts/make_architecture.py"
    assert not [path for path in SOURCES if not make_architecture.summary(path)]


def test_a_package_is_listed_room_by_room(tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    for path, text in {"__init__.py": "All.", "b.py": "One\nsentence.\n\nMore.", "room/__init__.py": "A room."}.items():
        (tmp_path / path).write_text(f'"""{text}"""\n')
    page = make_architecture.updated("# Title\n\n" + make_architecture.BEGIN + "\nold\n", tmp_path)
    listed = f"**{tmp_path.name}/**: All.\n\n- `b.py`: One sentence.\n\n**{tmp_path.name}/room/**: A room.\n"
    assert page.startswith("# Title\n\n" + make_architecture.BEGIN + "\n\n" + listed)
    assert "old" not in page
    with pytest.raises(ValueError, match="no line"):
        make_architecture.updated("# Title\n", tmp_path)


@pytest.mark.parametrize("page", sorted(ARCHITECTURE.parent.rglob("*.md")), ids=lambda page: page.name)
def test_documents_name_no_file_that_is_gone(page: Path) -> None:
    names = re.findall(r"(?<![\w/])((?:\w+/)+\w+\.py)\b", page.read_text())
    root = PACKAGE.parent
    assert not [name for name in names if not any((base / name).is_file() for base in (root, PACKAGE))]
