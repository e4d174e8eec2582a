"""Import paths of the last release give what they gave, with a warning that names the new path."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from gnrecon.deprecated_paths import MOVED, public_names


@pytest.mark.parametrize("old", MOVED)
def test_an_old_path_gives_the_objects_of_the_new_one(old: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=rf"^{old} is {MOVED[old]} since gnrecon 0\.2, and the old path ends"):
        moved = import_module(old)
    new = import_module(MOVED[old])
    assert public_names(new)
    for name in public_names(new):
        assert getattr(moved, name) is getattr(new, name)
    assert not hasattr(moved, "no_such_name")
    assert moved.__doc__ == new.__doc__
    sys.modules.pop(old)


@pytest.mark.parametrize(
    "line", ["from gnrecon.errors import UsageError", "from gnrecon import errors", "gnrecon.errors"]
)
def test_the_warning_shows_the_line_that_imports(tmp_path: Path, line: str) -> None:
    script = tmp_path / "script.py"
    script.write_text(f"import gnrecon\n\n{line}\n")
    done = subprocess.run([sys.executable, "-W", "default", script], capture_output=True, text=True, check=True)
    assert f"{script}:3: DeprecationWarning: gnrecon.errors is" in done.stderr


def test_modules_that_never_were_are_not_found() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'gnrecon\.no_such_module'"):
        import_module("gnrecon.no_such_module")
