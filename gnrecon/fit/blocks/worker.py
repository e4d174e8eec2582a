"""``python -m gnrecon.fit.blocks.worker FOLDER``: solves the blocks of a work folder whose numbers it reads from stdin.

The answer to each line is a line: ``done``, or the error. The process ends when its input does, and so with the process
that started it, however that ends.
"""

from __future__ import annotations

import os
import signal
import sys

from gnrecon.fit.blocks.block import solve_block
from gnrecon.runtime.parallel import fixed_sums

DONE = "done"
"""Answer of a worker that has solved a block."""


def main(folder: str) -> None:
    """Solve the requested blocks with one thread, so that processes do not compete for cores."""
    # Ctrl-C reaches the whole process group: the parent decides what ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with fixed_sums(1), os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8") as answers:
        # Output of libraries must not be taken for an answer.
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        for line in sys.stdin:
            try:
                solve_block(folder, int(line))
                answer = DONE
            except Exception as error:  # sent to the parent, which raises it
                answer = f"{type(error).__name__}: {' '.join(str(error).split())}"
            print(answer, file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
