"""A batch with broken scans: killed and continued, on a Dask cluster with a worker killed, and its throughput."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from benchmarks.batch_accidents import BROKEN, CONFIG, BatchWatcher, Cost, make_scans, run_command, running
from benchmarks.harness import command_line
from benchmarks.harness.tables import row_table
from gnrecon.runtime.errors import ExitCode, UsageError


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch with failures where a run has a fault.

    Raises
    ------
    UsageError
        When there are too few scans.
    OutputError
        When the result cannot be written.
    """
    chosen = _parser().parse_args(arguments)
    if chosen.scans < len(BROKEN) + 4:
        raise UsageError(f"At least {len(BROKEN) + 4} scans are needed, not {chosen.scans}.")
    command_line.require_folders(chosen.json)
    report: dict[str, Any] = command_line.provenance("batch", arguments) | {"jobs": chosen.jobs, "runs": {}}
    console = Console(highlight=False)
    with command_line.scratch_folder() as folder:
        good = make_scans(folder / "scans", chosen.scans - len(BROKEN))
        (folder / "batch.toml").write_text(CONFIG, encoding="utf-8")
        runs = _Runs(folder, good, chosen.jobs)
        for name, step in (("undisturbed", runs.undisturbed), ("killed", runs.killed), ("dask", runs.dask)):
            if name != "dask" or chosen.dask:
                console.print(f"bench: {name}", style="dim")
                report["runs"][name] = step()
        console.print("bench: one by one", style="dim")
        report["speed"] = runs.one_by_one(min(chosen.alone, len(good)))
    command_line.write_report(chosen.json, report)
    console.print(table(report))
    passed = [
        sound(one, len(good)) and one["disturbed"] == (name != "undisturbed") for name, one in report["runs"].items()
    ]
    return ExitCode.OK if all(passed) and report["speed"]["same_bytes"] else ExitCode.BATCH


def sound(one: dict[str, Any], good: int) -> bool:
    """Return whether all good scans were made, once and with the same bytes, and each broken one was named."""
    return (
        one["exit_code"] == ExitCode.BATCH
        and one["meshes"] == good
        and one["causes"] == BROKEN
        and not one["twice"]
        and one["same_bytes"]
    )


class _Runs:
    """Runs of the same scans, each into its own folder."""

    def __init__(self, folder: Path, good: Sequence[str], jobs: int) -> None:
        self._folder, self._good, self._jobs = folder, good, jobs

    def undisturbed(self) -> dict[str, Any]:
        """Run without a disturbance."""
        with BatchWatcher(self._output("undisturbed")) as watcher:
            cost = run_command(*self._words("undisturbed"))
        return self._outcome("undisturbed", cost, watcher)

    def killed(self) -> dict[str, Any]:
        """Kill the batch when half of the good scans are finished, and start it again."""
        half = len(self._good) // 2
        with BatchWatcher(self._output("killed")) as watcher:
            ended = run_command(
                *self._words("killed"), disturb=lambda pid: len(watcher.finished()) >= half and _kill([pid])
            )
            finished = watcher.finished()
            cost = run_command(*self._words("killed"))
        outcome = self._outcome("killed", cost, watcher)
        unchanged = [one["name"] for one in _summary(self._output("killed")) if one["status"] == "unchanged"]
        counts = {"finished_before": len(finished), "unchanged": len(unchanged)}
        return outcome | counts | {"disturbed": ended.disturbed}

    def dask(self) -> dict[str, Any]:
        """Run on a cluster of local workers, one of which is killed when half of the good scans are finished."""
        half, output = len(self._good) // 2, self._output("dask")
        with BatchWatcher(output) as watcher:
            cost = run_command(
                *self._words("dask"),
                "--engine",
                "dask",
                disturb=lambda _: len(watcher.finished()) >= half and _kill(self._workers(output)[:1]),
            )
        return self._outcome("dask", cost, watcher)

    def _workers(self, output: Path) -> list[int]:
        """Return the processes of workers that have a good scan: grandparents of the scans' processes."""
        found = []
        for pid in running(output, "torus"):
            with contextlib.suppress(psutil.Error):
                fork_server = psutil.Process(pid).parent()
                worker = None if fork_server is None else fork_server.parent()
                found += [] if worker is None else [worker.pid]
        return found

    def one_by_one(self, count: int) -> dict[str, Any]:
        """Run some of the good scans by separate commands, and again by one batch."""
        config, scans = str(self._folder / "batch.toml"), [f"{name}.ply" for name in self._good[:count]]
        (self._folder / "alone").mkdir()
        costs = []
        for scan in scans:
            mesh = self._folder / "alone" / scan
            costs.append(
                run_command(
                    str(self._folder / "scans" / scan), "-o", str(mesh), "--config", config, "--set", "threads=1"
                )
            )
        listing = self._folder / "scans" / "some.list"
        listing.write_text("\n".join(scans), encoding="utf-8")
        words = ["--list", str(listing), "--config", config, "--jobs", str(self._jobs), "--format", "ply", "--reports"]
        together = run_command("batch", *words, "-o", str(self._output("together")))
        same = all(
            (self._folder / "alone" / scan).read_bytes() == (self._output("together") / scan).read_bytes()
            for scan in scans
        )
        return {
            "scans": count,
            "one_by_one_seconds": sum(cost.seconds for cost in costs),
            "one_by_one_cpu_seconds": sum(cost.cpu_seconds for cost in costs),
            "batch_seconds": together.seconds,
            "batch_cpu_seconds": together.cpu_seconds,
            "ratio": sum(cost.seconds for cost in costs) / together.seconds,
            "cpu_ratio": sum(cost.cpu_seconds for cost in costs) / together.cpu_seconds,
            "same_bytes": same,
        } | _overheads(self._output("together"))

    def _output(self, name: str) -> Path:
        return self._folder / name

    def _words(self, name: str) -> list[str]:
        words = ["batch", str(self._folder / "scans"), "-o", str(self._output(name)), "--format", "ply"]
        return [*words, "--jobs", str(self._jobs), "--config", str(self._folder / "batch.toml")]

    def _outcome(self, name: str, cost: Cost, watcher: BatchWatcher) -> dict[str, Any]:
        """Return the figures of a run; its meshes and configurations are compared with those of the undisturbed one."""
        scans, output = _summary(self._output(name)), self._output(name)
        files = [path.name for path in sorted(self._output("undisturbed").glob("torus-*"))]
        return {
            "exit_code": cost.exit_code,
            "disturbed": cost.disturbed,
            "seconds": cost.seconds,
            "meshes": sum(one["status"] != "failed" for one in scans),
            "causes": {one["name"]: one["cause"] for one in scans if one["status"] == "failed"},
            "messages": {one["name"]: one["message"] for one in scans if one["status"] == "failed"},
            "twice": watcher.twice(),
            "same_bytes": all(
                (output / file).is_file()
                and (output / file).read_bytes() == (self._output("undisturbed") / file).read_bytes()
                for file in files
            ),
        }


def _kill(pids: Sequence[int]) -> bool:
    """Kill processes; return whether there were any."""
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    return bool(pids)


def _summary(output: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((output / "summary.json").read_text(encoding="utf-8"))["scans"]
    return found


def _overheads(output: Path) -> dict[str, float]:
    """Return the median seconds that a scan's process took in addition to its reconstruction."""
    overheads = sorted(
        one["seconds"] - json.loads(Path(one["report"]).read_text(encoding="utf-8"))["resources"]["seconds"]
        for one in _summary(output)
    )
    return {"overhead_seconds": overheads[len(overheads) // 2]}


def table(report: dict[str, Any]) -> Table:
    """Return the outcome of the runs, and the speed."""
    rows = []
    for name, one in report["runs"].items():
        named = sum(one["causes"].get(scan) == cause for scan, cause in BROKEN.items())
        counts = (one["exit_code"], one["meshes"], f"{named} of {len(BROKEN)}", len(one["twice"]))
        rows.append((name, *map(str, counts), "yes" if one["same_bytes"] else "NO", f"{one['seconds']:.0f}"))
    speed = report["speed"]
    caption = (
        f"{report['jobs']} scans at a time, one thread each. {speed['scans']} scans one by one take "
        f"{speed['ratio']:.2f} times as long as by a batch, and {speed['cpu_ratio']:.2f} times the processor time; a "
        f"scan's process takes {speed['overhead_seconds']:.2f} s in addition to its reconstruction."
    )
    headings = ("run", "exit", "meshes", "causes", "twice", "same bytes", "seconds")
    return row_table(headings, rows, caption=caption)


def _parser() -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("batch", __doc__)
    parser.add_argument("--scans", type=int, default=40, metavar="N", help="scans, 6 of them broken (default: 40)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="scans at a time (default: 2)")
    parser.add_argument("--alone", type=int, default=12, metavar="N", help="scans by separate commands (default: 12)")
    parser.add_argument("--no-dask", dest="dask", action="store_false", help="leave out the Dask cluster")
    command_line.add_outputs(parser)
    return parser
