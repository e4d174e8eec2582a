"""Runs the paper's experiments that are not finished, then draws all figures and writes the table.

``./scripts/reproduce [--data FOLDER] [--budget SECONDS] [--only PROBLEM ...] -o FOLDER``. Each problem is learned by
Gauss-Newton, L-BFGS and Adam for the budget. Finished experiments are kept: a second call continues the first.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness.command_line import require_matplotlib

from gnrecon.cli.learn_problem import LearnOptions
from gnrecon.runtime.errors import ExitCode, GnreconError
from gnrecon.runtime.files import write_text
from reproduction.experiments import PROBLEMS, Experiment, as_csv, as_markdown, experiments, interrupted
from reproduction.figures import draw_convergence, draw_surfaces


def main(arguments: Sequence[str]) -> int:
    """Run the experiments that the arguments name; return the exit code."""
    chosen = _parser().parse_args(arguments)
    chosen.output.mkdir(parents=True, exist_ok=True)
    done: list[Experiment] = []
    try:
        require_matplotlib()
        for one in experiments(chosen.only, chosen.output):
            if not one.finished:
                print(f"{one.problem} by {one.optimiser}, {chosen.budget:g} s", file=sys.stderr, flush=True)
                options = LearnOptions(
                    one.optimiser, chosen.budget, chosen.steps, chosen.seed, chosen.resolution, True, chosen.threads
                )
                if interrupted(one.run(options, chosen.data)):
                    one.report.unlink()
                    return ExitCode.INTERRUPTED
            done.append(one)
    except GnreconError as error:
        print(f"reproduce: {error}", file=sys.stderr)
        return int(error.exit_code)
    _draw(done, chosen.output)
    print(as_markdown(done), end="")
    return ExitCode.OK


def _draw(done: Sequence[Experiment], folder: Path) -> None:
    draw_convergence(done, folder / "convergence.png")
    draw_surfaces(done, folder)
    write_text(folder / "table.csv", as_csv(done), overwrite=True)
    write_text(folder / "table.md", as_markdown(done), overwrite=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="reproduce", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="for all results")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="of bun_zipper.ply and rocker-arm.off")
    parser.add_argument("--budget", type=float, default=600.0, metavar="SECONDS", help="of each run; by default 600")
    parser.add_argument("--steps", type=int, help="most steps of each run")
    parser.add_argument("--only", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS), metavar="PROBLEM")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resolution", type=int, default=128, help="cells of the surfaces")
    parser.add_argument("--threads", type=int)
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
