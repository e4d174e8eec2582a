"""Runs every method on every scan of a case, and summarises the trials.

A method with several settings, such as Poisson with its octree depths, runs with each of them. The setting with the
smallest median of the symmetric mean distance is reported: the best that a user who knew the truth could choose.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.accuracy.methods import OURS, PEERS
from benchmarks.accuracy.problem import Case, Problem, save_mesh, save_scan, save_truth
from benchmarks.accuracy.trial import Job, run_trial
from gnrecon.options import Options

# Adam and L-BFGS fit the paper's network: one wide layer starts at the minimum of its linear fit, where they could
# only make it worse.
FITS: dict[str, dict[str, Any]] = {
    "gnrecon": {},
    "Adam": {"optimiser": "adam", "widths": (32, 32, 32)},
    "L-BFGS": {"optimiser": "lbfgs", "widths": (32, 32, 32)},
}
"""Options of gnrecon's own methods, in addition to those of the protocol."""


@dataclass(frozen=True)
class Protocol:
    """The conditions of all trials.

    Parameters
    ----------
    threads : processors and threads of a trial
    samples : samples on each surface for measuring
    depths : octree depths of Poisson
    filter_scales : widths of the filters of RIMLS and APSS, in the points' own radii
    options : options of `gnrecon.reconstruct`, by default none
    limit : seconds after which a trial counts as failed, by default none
    """

    threads: int = 2
    samples: int = 100_000
    depths: tuple[int, ...] = (7, 8, 9, 10)
    filter_scales: tuple[float, ...] = (2.0, 4.0)
    options: dict[str, Any] = field(default_factory=dict)
    limit: float | None = None

    def at_quality(self, quality: str | None) -> Protocol:
        """Return the same with gnrecon's option `quality`, unless it is None.

        Raises
        ------
        UsageError
            When gnrecon refuses the options: once, before all trials.
        """
        options = self.options if quality is None else self.options | {"quality": quality}
        Options.of(**options)
        return replace(self, options=options)

    def contestants(self, methods: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
        """Return the methods with their settings, a pair per trial."""
        return [(method, settings) for method in methods for settings in self._settings(method)]

    def _settings(self, method: str) -> list[dict[str, Any]]:
        poisson = {"Poisson": "n_threads", "MeshLab Poisson": "threads"}
        if method in OURS:
            return [self.options | FITS[method]]
        if method in poisson:
            return [{"depth": depth, poisson[method]: self.threads} for depth in self.depths]
        if method in ("RIMLS", "APSS"):
            return [{"filterscale": scale} for scale in self.filter_scales]
        return [{}]


def run_case(
    name: str,
    problem_of: Callable[[int], Problem],
    seeds: Sequence[int],
    methods: Sequence[str],
    protocol: Protocol,
    folder: Path,
) -> list[dict[str, Any]]:
    """Run all trials of a case, leaving their files in a new `folder`; return a record per trial.

    A record holds case, method, settings, seed, number of points, the trial's folder, and its figures or its error. The
    problems of all seeds, which `problem_of` returns, share one truth.

    Raises
    ------
    InputError
        When the case's files are missing or cannot be read.
    """
    folder.mkdir()
    truth, lid, records = folder / "truth.npz", folder / "lid.npz", []
    for seed in seeds:
        problem, scan = problem_of(seed), folder / f"scan-{seed}.npz"
        save_truth(problem.truth, truth)
        save_scan(problem.scan.points, problem.scan.normals, scan)
        if problem.lid is not None:
            save_mesh(problem.lid, lid)
        for number, (method, settings) in enumerate(protocol.contestants(methods)):
            print(f"bench: {name}, seed {seed}, {method} {settings or ''}", file=sys.stderr)
            given = settings | ({"outliers": True} if problem.outliers and method in PEERS else {})
            files = str(scan), str(truth)
            job = Job(method, *files, protocol.threads, protocol.samples, given, problem.surface_samples)
            job = job if problem.lid is None else replace(job, lid=str(lid))
            trial = folder / f"{seed}-{number}"
            record = {"case": name, "method": method, "settings": given, "seed": seed, "points": len(problem.scan)}
            records.append(record | {"folder": str(trial)} | run_trial(job, trial, protocol.limit))
    return records


def problems_of(case: Case, data: Path) -> Callable[[int], Problem]:
    """Return the function from a seed to the problem of a case whose files lie in the folder `data`."""
    return lambda seed: case.problem(data, seed)


def best_setting(records: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[str, Any]:
    """Return the medians of a method's setting with the least symmetric mean, of the settings that never failed.

    `keys` are the figures of the medians; a figure that a trial lacks, or has as None, is None. Where every setting
    failed, the first error is returned.
    """
    by_settings: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        by_settings.setdefault(str(record["settings"]), []).append(record)
    sound = [group for group in by_settings.values() if not any("error" in record for record in group)]
    if not sound:
        return {"error": next(record["error"] for record in records if "error" in record)}
    summaries = [
        {"settings": group[0]["settings"], "folder": group[0]["folder"]} | {key: _median(group, key) for key in keys}
        for group in sound
    ]
    return min(summaries, key=lambda summary: float(summary["chamfer_mean"]))


def _median(group: Sequence[dict[str, Any]], key: str) -> float | None:
    values = [record[key] for record in group if record.get(key) is not None]
    return median(values) if len(values) == len(group) else None
