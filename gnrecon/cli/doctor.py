"""Diagnoses the installation for ``gnrecon doctor``: what is installed, what is missing, and how to install it.

It must run when almost nothing else does, so only the standard library and rich are imported here. Each package is
imported in its own process, because a broken native library may crash the process that loads it.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from rich.console import Console
from rich.table import Table

from gnrecon.cli.system_packages import LIBRARIES, install_command, loading_fault, missing_library_packages

PACKAGES = {
    "fpsample": "fpsample",
    "gudhi": "gudhi",
    "jinja2": "jinja2",
    "laspy": "laspy",
    "lazrs": "lazrs",
    "manifold3d": "manifold3d",
    "numpy": "numpy",
    "open3d": "open3d",
    "pandas": "pandas",
    "pillow": "PIL",
    "psutil": "psutil",
    "pymeshlab": "pymeshlab",
    "rich": "rich",
    "safetensors": "safetensors",
    "scikit-image": "skimage",
    "scipy": "scipy",
    "threadpoolctl": "threadpoolctl",
    "tomli-w": "tomli_w",
    "torch": "torch",
    "trimesh": "trimesh",
    "typer": "typer",
}
"""What setup.cfg requires, by the name to install and the name to import."""


@dataclass(frozen=True)
class Check:
    """One line of the diagnosis.

    Parameters
    ----------
    name : what was checked
    ok : whether gnrecon can work with it
    found : what was found, in words
    remedy : the command or the advice that repairs it; empty when `ok`
    """

    name: str
    ok: bool
    found: str
    remedy: str = ""


def diagnose() -> list[Check]:
    """Return all checks, in the order in which faults are best repaired. Faults are results; nothing is raised."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        packages = list(pool.map(check_package, PACKAGES, PACKAGES.values()))
        devices = pool.submit(check_devices)
    folder = Path(tempfile.gettempdir())
    return [
        check_python(),
        *(check_library(library) for library in LIBRARIES),
        *packages,
        *check_plugins(),
        devices.result(),
        check_memory(),
        check_disk(Path.cwd()),
        check_writable(folder),
    ]


def render(checks: list[Check], console: Console) -> None:
    """Print a table of `checks`, and below it each remedy once."""
    table = Table("", "checked", "found")
    for check in checks:
        table.add_row("[green]ok[/]" if check.ok else "[red]fault[/]", check.name, _plain(check.found))
    console.print(table)
    for remedy in dict.fromkeys(check.remedy for check in checks if not check.ok):
        # Unwrapped, so that a command can be copied.
        console.print(remedy, markup=False, highlight=False, soft_wrap=True)


def _plain(text: str) -> str:
    """Return `text` safe from rich, which reads square brackets as markup."""
    return text.replace("[", r"\[")


def check_python() -> Check:
    """Return whether this Python is new enough."""
    ok = sys.version_info >= (3, 11)
    return Check("Python", ok, platform.python_version(), "" if ok else "Install Python 3.11 or newer.")


def check_library(library: str) -> Check:
    """Return whether the loader finds a shared library; the remedy installs all missing ones at once."""
    name = f"{library} (Debian package {LIBRARIES[library]})"
    fault = loading_fault(library)
    return Check(name, not fault, fault or "loads", install_command(missing_library_packages()) if fault else "")


def check_package(distribution: str, module: str) -> Check:
    """Return whether `module`, installed as `distribution`, can be imported."""
    ok, said = run_python(f"import {module}")
    try:
        version = importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        version = "not installed" if not ok else "of unknown version"
    if ok:
        return Check(distribution, True, version)
    remedy = f"{sys.executable} -m pip install --force-reinstall {distribution}"
    missing = missing_library_packages()
    # A package that is installed but fails while system libraries are missing most often needs those.
    if version != "not installed" and missing:
        remedy = install_command(missing)
    return Check(distribution, False, f"{version}: {said}", remedy)


def check_plugins() -> list[Check]:
    """Return, for each reader, writer and residual of a plug-in, whether it can be loaded."""
    from gnrecon.runtime.plugins import PluginKind, installed

    checks = []
    for plugin in (plugin for kind in get_args(PluginKind) for plugin in installed(kind)):
        code = f"from gnrecon.runtime.plugins import find; find({plugin.kind!r}, {plugin.entry.name!r}).load()"
        ok, said = run_python(code)
        remedy = "" if ok else f"Repair or uninstall {plugin.package}."
        checks.append(Check(f"{plugin.kind} {plugin.entry.name}", ok, plugin.package if ok else said, remedy))
    return checks


def check_devices() -> Check:
    """Return what torch can compute on."""
    code = """
import torch
cuda = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
print(f"CPU with {torch.get_num_threads()} threads; CUDA: {', '.join(cuda) or 'none'}")
"""
    ok, said = run_python(code)
    return Check("torch devices", ok, said, "" if ok else "Repair torch first.")


def check_memory(*, needed_bytes: int = 2 * 2**30) -> Check:
    """Return whether the free memory suffices for open3d, torch and the fit of a small scan."""
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        # The kernel's own estimate includes caches that it can free.
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                free = int(line.split()[1]) * 1024
    except (OSError, ValueError) as fault:
        return Check("memory", True, f"unknown ({fault})")
    found = f"{free / 2**30:.1f} of {whole / 2**30:.1f} GiB free"
    ok = free >= needed_bytes
    return Check("memory", ok, found, "" if ok else f"Free some memory: {needed_bytes / 2**30:.0f} GiB are needed.")


def check_disk(folder: Path, *, needed_bytes: int = 2**28) -> Check:
    """Return whether `folder` has space for a saved field and some meshes."""
    free = shutil.disk_usage(folder).free
    ok = free >= needed_bytes
    remedy = "" if ok else f"Free some disk: {needed_bytes / 2**20:.0f} MiB are needed in {folder}."
    return Check("disk", ok, f"{free / 2**30:.1f} GiB free in {folder}", remedy)


def check_writable(folder: Path) -> Check:
    """Return whether temporary files can be written to `folder`."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"gnrecon")
    except OSError as fault:
        remedy = f"Make {folder} writable, or set TMPDIR to a folder that is."
        return Check("temporary folder", False, str(fault), remedy)
    return Check("temporary folder", True, f"{folder} is writable")


def run_python(code: str, *, timeout_seconds: float = 120.0) -> tuple[bool, str]:
    """Run `code` in another process of this Python; return whether it succeeded, and the last line that it printed.

    For a process that a signal ended (a crash in native code), the line is the signal's name. The timeout leaves time
    for a first import from a slow disk.
    """
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=timeout_seconds)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {timeout_seconds:.0f} s"
    if done.returncode < 0:
        return False, f"crashed ({signal.Signals(-done.returncode).name})"
    lines = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    return done.returncode == 0, lines[-1] if lines else ""
