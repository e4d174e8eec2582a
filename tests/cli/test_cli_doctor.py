"""The diagnosis, on this installation and on broken ones."""

from __future__ import annotations

import configparser
import io
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from other_packages import install, packages
from rich.console import Console

import gnrecon
from gnrecon.cli import doctor, system_packages
from gnrecon.cli.doctor import Check


def shown(checks: list[Check], width: int = 100) -> str:
    console = Console(file=io.StringIO(), width=width)
    doctor.render(checks, console)
    return console.file.getvalue()  # type: ignore[attr-defined]


@pytest.fixture
def without_libusb(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which the loader does not find two libraries: a name that no machine has stands in for each."""
    libraries = {"libc.so.6": "libc6", "libno-such-usb.so.0": "libusb-1.0-0", "libno-such-gl.so.1": "libgl1"}
    monkeypatch.setattr(system_packages, "LIBRARIES", libraries)
    monkeypatch.setattr(doctor, "LIBRARIES", libraries)


def test_this_installation_is_sound() -> None:
    checks = doctor.diagnose()
    assert [check for check in checks if not check.ok] == []
    assert not any(check.remedy for check in checks)
    found = {check.name: check.found for check in checks}
    assert found["open3d"].startswith("0.")
    assert re.fullmatch(r"CPU with \d+ threads; CUDA: .+", found["torch devices"])
    assert set(doctor.PACKAGES) <= set(found)


def test_the_required_packages_are_those_of_setup_cfg(repository: Path) -> None:
    config = configparser.ConfigParser()
    config.read(repository / "setup.cfg")
    required = config["options"]["install_requires"].split()
    assert [re.split("[<>=!~]", requirement)[0] for requirement in required] == sorted(doctor.PACKAGES)


@pytest.mark.usefixtures("without_libusb")
def test_a_missing_library_is_named_with_one_command_for_all() -> None:
    assert doctor.check_library("libc.so.6").ok
    checks = [doctor.check_library(library) for library in ("libno-such-usb.so.0", "libno-such-gl.so.1")]
    for check in checks:
        assert not check.ok
        assert "cannot open shared object file" in check.found
        assert check.remedy == "sudo apt-get install -y libusb-1.0-0 libgl1"
    assert "libusb-1.0-0" in checks[0].name
    # Once, however many need it.
    assert shown(checks).count("sudo apt-get install") == 1


@pytest.mark.usefixtures("without_libusb")
def test_an_installed_package_that_fails_is_blamed_on_missing_libraries() -> None:
    check = doctor.check_package("numpy", "numpy.no_such_part")
    assert not check.ok
    assert "ModuleNotFoundError" in check.found
    assert check.remedy == "sudo apt-get install -y libusb-1.0-0 libgl1"


def test_a_package_that_is_not_installed() -> None:
    check = doctor.check_package("no-such-distribution", "no_such_module")
    assert not check.ok
    assert check.found.startswith("not installed")
    assert check.remedy.endswith("-m pip install --force-reinstall no-such-distribution")


def test_what_other_packages_bring_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, "fine", "def read(path):\n    return None", readers={"fine": "read"})
    install(tmp_path, "broken", "import no_such_library", writers={"bad": "write"})
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (tmp_path, Path(gnrecon.__file__).parents[1]))))
    with packages(tmp_path):
        fine, broken = doctor.check_plugins()
    assert fine == Check("reader fine", True, "the package fine 1.2")
    assert (broken.name, broken.ok) == ("writer bad", False)
    assert "cannot be loaded (ModuleNotFoundError: No module named 'no_such_library')" in broken.found
    assert broken.remedy == "Repair or uninstall the package broken 1.2."


def test_a_crash_in_native_code_is_survived_and_named() -> None:
    assert doctor.run_python("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)") == (False, "crashed (SIGSEGV)")


def test_an_import_that_hangs_is_given_up() -> None:
    ok, said = doctor.run_python("import time; time.sleep(60)", timeout_seconds=0.2)
    assert not ok
    assert "no answer" in said


def test_short_memory_and_disk_are_faults(tmp_path: Path) -> None:
    for check in (doctor.check_memory(needed_bytes=2**60), doctor.check_disk(tmp_path, needed_bytes=2**60)):
        assert not check.ok
        assert check.remedy.startswith("Free some")


def test_a_temporary_folder_that_is_gone(tmp_path: Path) -> None:
    check = doctor.check_writable(tmp_path / "gone")
    assert not check.ok
    assert "TMPDIR" in check.remedy
    assert doctor.check_writable(Path(tempfile.gettempdir())).ok


def test_the_table_shows_brackets_as_they_are_and_commands_in_one_line() -> None:
    command = "sudo apt-get install -y " + " ".join(f"package-{i}" for i in range(20))
    text = shown([Check("a", True, "[Errno 2] fine"), Check("b", False, "gone", command)], width=60)
    assert "[Errno 2] fine" in text
    assert command in text.splitlines()


def test_the_missing_packages_are_printed_one_a_line(repository: Path) -> None:
    script = repository / "gnrecon" / "cli" / "system_packages.py"
    done = subprocess.run([sys.executable, "-I", script], capture_output=True, text=True, check=True)
    expected = system_packages.missing_venv_packages() + system_packages.missing_library_packages()
    assert done.stdout.split() == expected


def test_a_python_without_ensurepip_wants_debian_s_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system_packages.importlib.util, "find_spec", lambda name: None if name == "ensurepip" else name)
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert system_packages.missing_venv_packages() == [f"python{version}-venv"]
