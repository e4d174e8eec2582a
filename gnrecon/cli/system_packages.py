"""System libraries that Python wheels expect from the machine, and the Debian packages that bring them.

The loader itself is tried, so that a library from another source than Debian counts as well. Only the standard library
is imported, because the first set-up runs the file by its path before anything is installed: ``python3 -I
gnrecon/cli/system_packages.py`` prints the missing packages, one per line.
"""

from __future__ import annotations

import ctypes
import importlib.util
import sys

# open3d's wheel links against these, pymeshlab's plugins against libOpenGL, and neither brings them.
LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libOpenGL.so.0": "libopengl0",
    "libgomp.so.1": "libgomp1",
}


def loading_fault(library: str) -> str:
    """Return why the shared library named `library` cannot be loaded, or the empty string when it can."""
    try:
        ctypes.CDLL(library)
    except OSError as fault:
        return str(fault)
    return ""


def missing_library_packages() -> list[str]:
    """Return the Debian packages of those `LIBRARIES` that cannot be loaded."""
    return [package for library, package in LIBRARIES.items() if loading_fault(library)]


def missing_venv_packages() -> list[str]:
    """Return the Debian package with the part of Python that makes virtual environments, where it is missing."""
    # Debian keeps ensurepip out of its main Python package; without it `python3 -m venv` ends half-way.
    if importlib.util.find_spec("ensurepip") is not None and importlib.util.find_spec("venv") is not None:
        return []
    return [f"python{sys.version_info.major}.{sys.version_info.minor}-venv"]


def install_command(packages: list[str]) -> str:
    """Return the one command that installs `packages` on Debian and Ubuntu."""
    return "sudo apt-get install -y " + " ".join(packages)


if __name__ == "__main__":
    for name in missing_venv_packages() + missing_library_packages():
        print(name)
