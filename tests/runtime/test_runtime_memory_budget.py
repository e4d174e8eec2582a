"""What a run may take is the least that the shell, the control groups and the machine leave."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from gnrecon.runtime import memory_budget
from gnrecon.runtime.errors import ExitCode, MemoryLimitError, failure
from gnrecon.runtime.memory import status_bytes
from gnrecon.runtime.memory_budget import (
    Budget,
    available_memory_mb,
    is_capped,
    kills_for_memory,
    require_memory,
    require_room_for_libraries,
)
from gnrecon.runtime.parallel import fixed_sums


def test_this_machine_has_some() -> None:
    assert available_memory_mb() > 0
    assert not is_capped()
    require_memory(1.0)
    require_room_for_libraries(1e9)


@pytest.mark.parametrize(("number", "letter"), [(resource.RLIMIT_AS, "v"), (resource.RLIMIT_DATA, "d")])
def test_limits_of_the_shell(monkeypatch: pytest.MonkeyPatch, number: int, letter: str) -> None:
    used = status_bytes("VmSize" if letter == "v" else "VmData")
    assert used is not None
    most = used + 500_000_000
    unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda asked: (most, most) if asked == number else unlimited)
    assert is_capped()
    assert available_memory_mb() == pytest.approx(500, abs=100)
    with pytest.raises(MemoryLimitError, match=rf"take 1,000 MB of addresses, and the limit.*ulimit -{letter}"):
        require_room_for_libraries(1000.0)
    require_room_for_libraries(100.0)
    require_room_for_libraries((most - 1) / 1e6, in_new_process=True)


def test_threads_reserve_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_budget, "_budgets", lambda: [Budget(200.0, "a limit", addresses=True)])
    with fixed_sums(1):
        require_memory(0.0)
    with fixed_sums(4), pytest.raises(MemoryLimitError, match="needs about 288 MB of memory more, and a limit leaves"):
        require_memory(0.0)


def group(folder: Path, **files: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name.replace("_", ".", 1)).write_text(f"{content}\n")


def test_groups_of_version_2(tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.write_text("0::/user/run\n")
    group(tmp_path / "groups", memory_stat="inactive_file 0")  # the root has no limit
    group(tmp_path / "groups/user", memory_max=900_000_000, memory_current=500_000_000, memory_stat="inactive_file 5")
    group(tmp_path / "groups/user/run", memory_max="max", memory_current=10, memory_stat="inactive_file 0")
    (budget,) = memory_budget._group_budgets(groups=tmp_path / "groups", own=own)
    assert budget == Budget(400.000005, "the limit of the control group")


def test_groups_of_version_1_in_a_container(tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.write_text("5:cpu,cpuacct:/docker/a\n3:memory:/docker/a\n")
    folder = tmp_path / "groups/memory"
    folder.mkdir(parents=True)
    (folder / "memory.limit_in_bytes").write_text("1000000000")
    (folder / "memory.usage_in_bytes").write_text("900000000")
    (folder / "memory.stat").write_text("cache 7\ntotal_inactive_file 300000000\n")
    (budget,) = memory_budget._group_budgets(groups=tmp_path / "groups", own=own)
    assert budget.mb == 400.0


def test_the_system_counts_its_kills(tmp_path: Path) -> None:
    assert kills_for_memory() >= 0
    (tmp_path / "vmstat").write_text("nr_free_pages 5\noom_kill 3\n")
    assert kills_for_memory(path=tmp_path / "vmstat") == 3
    assert kills_for_memory(path=tmp_path / "missing") == 0


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
    ],
)
def test_errors_of_libraries_that_found_no_memory(error: BaseException) -> None:
    sentence, code = failure(error)
    assert (sentence[:27], code) == ("There is not enough memory.", ExitCode.MEMORY)
