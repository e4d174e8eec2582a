"""Looks the installed packages up among known vulnerabilities, by pip-audit; needs a connection to the package index.

pip-audit ends well where it could look up nothing, as behind a mirror. Here, that is an exit code of its own.
Exit codes: 0 no vulnerability is known, 1 some are, 2 a package that gnrecon requires could not be looked up.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from typing import Any

from make_licences import closure, required


def audited(report: dict[str, Any], names: set[str]) -> tuple[int, list[str]]:
    """Return the exit code and the lines to print.

    Parameters
    ----------
    report : what pip-audit printed as JSON
    names : of the packages that must have been looked up
    """
    packages = report["dependencies"]
    known = [
        f"{package['name']} {package['version']}: {flaw['id']}, mended in {flaw['fix_versions']}"
        for package in packages
        for flaw in package.get("vulns", [])
    ]
    missing = sorted(names - {package["name"] for package in packages if "skip_reason" not in package})
    looked_up = f"{len(names) - len(missing)} of the {len(names)} packages that gnrecon requires were looked up."
    if missing:
        looked_up += f" Not: {', '.join(missing)}."
    return (1 if known else 2 if missing else 0), [*known, looked_up]


def main() -> int:
    """Run pip-audit and print what it found."""
    if importlib.util.find_spec("pip_audit") is None:
        print("pip-audit is not installed: pip install pip-audit", file=sys.stderr)
        return 2
    words = [sys.executable, "-m", "pip_audit", "--local", "--format", "json", "--progress-spinner", "off"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    try:
        report = json.loads(done.stdout)
    except ValueError:  # without a connection, it prints no report
        print(done.stderr.strip() or "pip-audit printed nothing.", file=sys.stderr)
        return 2
    code, lines = audited(report, set(closure(required())))
    print("\n".join(lines))
    return code


if __name__ == "__main__":
    sys.exit(main())
