"""How much more memory this process may take: by limits of its shell and its control groups, and by what is free.

Native code that runs into such a limit aborts or waits for ever, so a run is refused before the work that would.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gnrecon.runtime.errors import MemoryLimitError
from gnrecon.runtime.memory import status_bytes

ADVICE = (
    "use fewer points (--max-points), a coarser mesh (--resolution), smaller --widths or --quality draft, or raise the "
    "limit."
)


@dataclass(frozen=True)
class Budget:
    """Memory that is left, in MB of 10^6 bytes, and what limits it; `addresses` says that reserved memory counts."""

    mb: float
    limit: str
    addresses: bool = False


def require_memory(needed_mb: float, *, thread_addresses_mb: float = 72.0) -> None:
    """Refuse a run that is expected to need more memory than is left.

    To be called in the block that limits the run's threads, see `gnrecon.runtime.compute_limits.limited`.

    Parameters
    ----------
    needed_mb : expected peak of resident memory, in MB of 10^6 bytes
    thread_addresses_mb : addresses that a thread reserves, for its stack and for its arena of the C library's allocator

    Raises
    ------
    MemoryLimitError
        When it is.
    """
    from gnrecon.runtime.parallel import worker_count

    growth = max(0.0, needed_mb - (status_bytes("VmRSS") or 0) / 1e6)
    for budget in _budgets():
        more = growth + (worker_count() * thread_addresses_mb if budget.addresses else 0.0)
        if more > budget.mb:
            raise MemoryLimitError(
                f"The run needs about {more:,.0f} MB of memory more, and {budget.limit} leaves {budget.mb:,.0f} MB; "
                f"{ADVICE}"
            )


def require_room_for_libraries(least_mb: float, *, in_new_process: bool = False) -> None:
    """Refuse to import the numerical libraries under a limit in which they abort or wait for ever.

    Parameters
    ----------
    least_mb : addresses that they and their first buffers take, in MB of 10^6 bytes
    in_new_process : whether a process that is still to be started imports them, so that this one's use does not count

    Raises
    ------
    MemoryLimitError
        When the limit is lower.
    """
    for budget in _shell_budgets(unused=in_new_process):
        if budget.mb < least_mb:
            raise MemoryLimitError(
                f"The libraries of a run take {least_mb:,.0f} MB of addresses, and {budget.limit} leaves "
                f"{budget.mb:,.0f} MB; raise that limit."
            )


def is_capped() -> bool:
    """Whether the shell limits the memory of this process, so that native code may be ended by it."""
    return bool(list(_shell_budgets()))


def available_memory_mb() -> float:
    """Return the memory that is left, in MB of 10^6 bytes."""
    return min(budget.mb for budget in _budgets())


def kills_for_memory(*, path: Path = Path("/proc/vmstat")) -> int:
    """Return how many processes the system has killed since its start because memory ran out; 0 where unknown."""
    with suppress(OSError, ValueError):
        lines = (line.split() for line in path.read_text(encoding="ascii").splitlines())
        return next((int(value) for name, value in lines if name == "oom_kill"), 0)
    return 0


def _budgets() -> Iterator[Budget]:
    import psutil

    yield from _shell_budgets()
    yield from _group_budgets()
    free = psutil.virtual_memory().available
    with suppress(OSError, RuntimeError):  # some containers hide the swap space
        free += psutil.swap_memory().free
    yield Budget(free / 1e6, "this machine")


def _shell_budgets(*, unused: bool = False) -> Iterator[Budget]:
    limits = ((resource.RLIMIT_AS, "VmSize", "v"), (resource.RLIMIT_DATA, "VmData", "d"))
    for number, name, letter in limits:
        soft, used = resource.getrlimit(number)[0], status_bytes(name)
        if soft != resource.RLIM_INFINITY and used is not None:
            left = soft if unused else max(0, soft - used)
            yield Budget(left / 1e6, f"the limit of the shell (ulimit -{letter})", addresses=True)


def _group_budgets(*, groups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> Iterator[Budget]:
    """The control group of this process and those above it, of version 2 or 1 (manual page cgroups(7))."""
    lines: list[str] = []
    with suppress(OSError):
        lines = own.read_text(encoding="utf-8").splitlines()
    for line in lines or ["0::/"]:
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root, names = groups, ("memory.max", "memory.current", "inactive_file")
        if controllers:
            root = groups / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        # Within a container, the path may be that of the host; its own group is then the root.
        place = Path(root, path.lstrip("/"))
        for folder in [one for one in (place, *place.parents) if one == root or root in one.parents]:
            with suppress(OSError, ValueError):
                most, used = (int((folder / name).read_text(encoding="ascii")) for name in names[:2])
                left = most - used + _reclaimable(folder / "memory.stat", names[2])
                yield Budget(max(0.0, left / 1e6), "the limit of the control group")


def _reclaimable(path: Path, name: str) -> int:
    """Bytes of cached files, which count as used and are given up when memory is needed."""
    lines = (line.split() for line in path.read_text(encoding="ascii").splitlines())
    return next((int(value) for word, value in lines if word == name), 0)
