"""Starts a benchmark by its name; without a name, lists the benchmarks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

from gnrecon.runtime.errors import ExitCode, GnreconError


@dataclass(frozen=True)
class Benchmark:
    """A module with a function ``main(arguments) -> exit code``, and a line about what it measures."""

    module: str
    description: str


BENCHMARKS = {
    "paper": Benchmark("accuracy.paper_shapes", "the paper's two shapes, gnrecon compared with screened Poisson"),
    "accuracy": Benchmark("accuracy.many_scans", "gnrecon compared with its peers on clean, noisy and sparse scans"),
    "ablation": Benchmark("accuracy.ablation", "the default fit without one of its parts at a time"),
    "uncertainty": Benchmark("uncertainty", "sigma compared with the true error, on known shapes"),
    "speed": Benchmark("speed", "whole commands on growing scans, compared with screened Poisson: time and memory"),
    "estimate": Benchmark("estimates", "what `gnrecon info` expects of a run, compared with what it takes"),
    "engine": Benchmark("engine.measurements", "Gauss-Newton compared with a plain version of the paper's algorithm"),
    "learn": Benchmark("shape_learning", "shape learning by three optimisers, and one step's time"),
    "transport": Benchmark("transport_terms", "the effect of the terms of moving surfaces that the paper neglects"),
    "blocks": Benchmark("scaling", "scans of up to two million points, fitted by blocks: cost and seams"),
    "ingest": Benchmark("streamed_reading", "reading of 20 million points, in every format that is streamed"),
    "orient": Benchmark("accuracy.orientation", "estimated normals, and their meshes, compared with open3d's"),
    "refine": Benchmark("remeshing", "remeshing and decimation, compared with pymeshlab and manifold3d"),
    "batch": Benchmark("batch_recovery", "many scans, some broken, killed and continued; and throughput"),
    "fuzz": Benchmark("fuzz", "damaged and odd scans in whole reconstructions: how they end, time and memory"),
    "inputs": Benchmark("inputs", "scans of the kinds that people have, compared with screened Poisson"),
    "export": Benchmark("extraction", "extraction at growing resolutions, compared with the whole grid"),
}


def listing() -> str:
    """Return the benchmarks, one per line."""
    width = max(len(name) for name in BENCHMARKS)
    lines = [f"  {name:{width}}  {benchmark.description}" for name, benchmark in BENCHMARKS.items()]
    return "\n".join(["usage: bench NAME [options]     (bench NAME --help shows the options)", "", *lines])


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark that the first argument names with the other arguments; return the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(listing())
        return ExitCode.OK
    name, *rest = arguments
    if name not in BENCHMARKS:
        print(f"bench: there is no benchmark {name!r}; expected one of {', '.join(BENCHMARKS)}.", file=sys.stderr)
        return ExitCode.USAGE
    try:
        return int(import_module(f"benchmarks.{BENCHMARKS[name].module}").main(rest))
    except GnreconError as error:
        print(f"bench: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
