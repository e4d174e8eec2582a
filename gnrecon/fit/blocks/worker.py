"""``python -m gnrecon.fit.blocks.worker FOLDER``: solves blocks of a work folder, whose numbers come by standard input.

The answer to each line is a line: ``done``, or why the block could not be solved. It ends with its input, and so with
the process that gives it work, however that ends.
"""

from __future__ import annotations

import os
import signal
import sys

from gnrecon.fit.blocks.block import solve_block

DONE = "done"


def main(folder: str) -> None:
    """Solve the blocks that are asked for, one thread each, so that processes do not fight for cores."""
    import torch

    # An interrupt from the keyboard reaches the whole group of processes: the one that gives the work decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    with os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8") as answers:
        # What a library prints is no answer.
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        for line in sys.stdin:
            try:
                solve_block(folder, int(line))
                answer = DONE
            except Exception as error:  # told to the one who asked, who ends the run with it
                answer = f"{type(error).__name__}: {' '.join(str(error).split())}"
            print(answer, file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
