"""A batch with broken scans: killed and continued, on a Dask cluster with a worker killed, and its throughput."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from benchmarks.batch.command import Cost, run
from benchmarks.batch.scans import BROKEN, CONFIG, make_scans
from benchmarks.batch.witness import Witness, running
from benchmarks.provenance import provenance
from gnrecon.runtime.errors import ExitCode, UsageError
from gnrecon.runtime.files import write_text


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark as the arguments say; return the exit code, that of a batch where a run is not as it should be.

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
    report: dict[str, Any] = provenance("batch", arguments) | {"jobs": chosen.jobs, "runs": {}}
    console = Console(highlight=False)
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        folder = Path(temporary)
        good = make_scans(folder / "scans", chosen.scans - len(BROKEN))
        (folder / "batch.toml").write_text(CONFIG, encoding="utf-8")
        bench = _Bench(folder, good, chosen.jobs)
        for name, step in (("undisturbed", bench.undisturbed), ("killed", bench.killed), ("dask", bench.dask)):
            if name != "dask" or chosen.dask:
                console.print(f"bench: {name}", style="dim")
                report["runs"][name] = step()
        console.print("bench: one by one", style="dim")
        report["speed"] = bench.one_by_one(min(chosen.alone, len(good)))
    if chosen.json:
        write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    console.print(table(report))
    sounds = [
        sound(one, len(good)) and one["disturbed"] == (name != "undisturbed") for name, one in report["runs"].items()
    ]
    return ExitCode.OK if all(sounds) and report["speed"]["same_bytes"] else ExitCode.BATCH


def sound(one: dict[str, Any], good: int) -> bool:
    """Whether a run ended as it should: all good scans made, each broken one named, nothing twice, the same bytes."""
    return (
        one["exit_code"] == ExitCode.BATCH
        and one["meshes"] == good
        and one["causes"] == BROKEN
        and not one["twice"]
        and one["same_bytes"]
    )


class _Bench:
    """The runs, of the same scans into folders of their own."""

    def __init__(self, folder: Path, good: Sequence[str], jobs: int) -> None:
        self._folder, self._good, self._jobs = folder, good, jobs

    def undisturbed(self) -> dict[str, Any]:
        """All at once."""
        with Witness(self._output("undisturbed")) as witness:
            cost = run(*self._words("undisturbed"))
        return self._told("undisturbed", cost, witness)

    def killed(self) -> dict[str, Any]:
        """Killed when half of the good scans are finished, and started again."""
        half = len(self._good) // 2
        with Witness(self._output("killed")) as witness:
            ended = run(*self._words("killed"), deed=lambda pid: len(witness.finished()) >= half and _kill([pid]))
            finished = witness.finished()
            cost = run(*self._words("killed"))
        told = self._told("killed", cost, witness)
        unchanged = [one["name"] for one in _summary(self._output("killed")) if one["status"] == "unchanged"]
        counts = {"finished_before": len(finished), "unchanged": len(unchanged)}
        return told | counts | {"disturbed": ended.disturbed}

    def dask(self) -> dict[str, Any]:
        """On a cluster of local workers, one of which is killed when half of the good scans are finished."""
        half, output = len(self._good) // 2, self._output("dask")
        with Witness(output) as witness:
            cost = run(
                *self._words("dask"),
                "--engine",
                "dask",
                deed=lambda _: len(witness.finished()) >= half and _kill(self._workers(output)[:1]),
            )
        return self._told("dask", cost, witness)

    def _workers(self, output: Path) -> list[int]:
        """Processes of workers that have a good scan at hand: the parents of the processes that fork the scans' own."""
        found = []
        for pid in running(output, "torus"):
            with contextlib.suppress(psutil.Error):
                server = psutil.Process(pid).parent()
                worker = None if server is None else server.parent()
                found += [] if worker is None else [worker.pid]
        return found

    def one_by_one(self, count: int) -> dict[str, Any]:
        """Some of the good scans by commands of their own, and again by a batch, in which nothing breaks."""
        config, scans = str(self._folder / "batch.toml"), [f"{name}.ply" for name in self._good[:count]]
        (self._folder / "alone").mkdir()
        costs = []
        for scan in scans:
            mesh = self._folder / "alone" / scan
            costs.append(
                run(str(self._folder / "scans" / scan), "-o", str(mesh), "--config", config, "--set", "threads=1")
            )
        listing = self._folder / "scans" / "some.list"
        listing.write_text("\n".join(scans), encoding="utf-8")
        words = ["--list", str(listing), "--config", config, "--jobs", str(self._jobs), "--format", "ply", "--reports"]
        together = run("batch", *words, "-o", str(self._output("together")))
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

    def _told(self, name: str, cost: Cost, witness: Witness) -> dict[str, Any]:
        """What a run came to; its meshes and configurations are compared with those of the undisturbed one."""
        scans, output = _summary(self._output(name)), self._output(name)
        files = [path.name for path in sorted(self._output("undisturbed").glob("torus-*"))]
        return {
            "exit_code": cost.exit_code,
            "disturbed": cost.disturbed,
            "seconds": cost.seconds,
            "meshes": sum(one["status"] != "failed" for one in scans),
            "causes": {one["name"]: one["cause"] for one in scans if one["status"] == "failed"},
            "messages": {one["name"]: one["message"] for one in scans if one["status"] == "failed"},
            "twice": witness.twice(),
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
    """Seconds a scan that its process took beside the reconstruction itself, the median."""
    beyond = sorted(
        one["seconds"] - json.loads(Path(one["report"]).read_text(encoding="utf-8"))["resources"]["seconds"]
        for one in _summary(output)
    )
    return {"overhead_seconds": beyond[len(beyond) // 2]}


def table(report: dict[str, Any]) -> Table:
    """Return what the runs came to, and the speed."""
    shown = Table(caption=f"{report['jobs']} scans at a time, one thread each.")
    for heading in ("run", "exit", "meshes", "causes", "twice", "same bytes", "seconds"):
        shown.add_column(heading, no_wrap=True)
    for name, one in report["runs"].items():
        named = sum(one["causes"].get(scan) == cause for scan, cause in BROKEN.items())
        row = (one["exit_code"], one["meshes"], f"{named} of {len(BROKEN)}", len(one["twice"]))
        shown.add_row(name, *map(str, row), "yes" if one["same_bytes"] else "NO", f"{one['seconds']:.0f}")
    speed = report["speed"]
    shown.caption = (
        f"{shown.caption} {speed['scans']} scans one by one take {speed['ratio']:.2f} times as long as by a batch, and "
        f"{speed['cpu_ratio']:.2f} times the processor time; a scan's process takes {speed['overhead_seconds']:.2f} s "
        "beside its reconstruction."
    )
    return shown


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench batch", description=__doc__)
    parser.add_argument("--scans", type=int, default=40, metavar="N", help="scans, 6 of them broken (default: 40)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="scans at a time (default: 2)")
    parser.add_argument("--alone", type=int, default=12, metavar="N", help="scans one by one (default: 12)")
    parser.add_argument("--no-dask", dest="dask", action="store_false", help="leave out the Dask cluster")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    return parser
