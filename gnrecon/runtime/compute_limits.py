"""The threads, the device and the memory that a run computes with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from gnrecon.runtime.errors import GnreconError, MemoryLimitError, UsageError
from gnrecon.runtime.parallel import fixed_sums, torch_threads


@contextmanager
def limited(threads: int | None, *, same_bytes: bool = True) -> Iterator[None]:
    """Run a block with this number of threads (None: torch's number), and report failed allocations as such.

    What the block computes does not depend on the number, see `fixed_sums`, unless `same_bytes` is False: then several
    threads share each product. Other threads of the program, and those that it starts later, keep their number of
    torch threads.

    Raises
    ------
    MemoryLimitError
        When an allocation in the block failed.
    """
    try:
        with fixed_sums(threads) if same_bytes else torch_threads(threads):
            yield
    except GnreconError:  # among them a MemoryLimitError, which is a MemoryError and already says what is too large
        raise
    except MemoryError as error:
        raise _out_of_memory(error) from error
    except RuntimeError as error:
        # torch reports a failed allocation as a RuntimeError, on the CPU by its text alone.
        if isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error):
            raise _out_of_memory(error) from error
        raise


def require_device(device: str) -> None:
    """Refuse a device that torch does not have.

    Raises
    ------
    UsageError
        When the device is unknown or missing.
    """
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise UsageError(f"The device is {device!r}, but must be cpu or cuda.")
    if kind == "cuda" and not torch.cuda.is_available():
        raise UsageError("The device is 'cuda', but torch finds no CUDA GPU; `gnrecon doctor` lists its devices.")


def _out_of_memory(error: Exception) -> MemoryLimitError:
    return MemoryLimitError(
        f"There is not enough memory ({str(error).splitlines()[0] if str(error) else 'allocation failed'}); "
        f"use fewer points (--max-points) or a coarser mesh (--resolution)."
    )
