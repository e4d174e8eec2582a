"""Peaks of memory against allocations of known size: in blocks, nested, in threads, sampled, and of the process."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from threading import Barrier, Thread

import pytest
from held_memory import resident, use

from gnrecon.runtime import memory
from gnrecon.runtime.memory import PeakMemory, process_peak_mb

SLACK = 12.0  # MB that the interpreter, the allocator and other threads may allocate in between


def test_a_peak_is_that_of_its_own_stretch() -> None:
    before = resident()
    with PeakMemory() as large:
        use(200)
    with PeakMemory() as small:
        use(50)
    assert large.mb == pytest.approx(before + 200, abs=SLACK)
    assert small.mb == pytest.approx(before + 50, abs=SLACK)


def test_the_peak_of_the_process_outlives_its_stretches() -> None:
    before = resident()
    with PeakMemory():
        use(300)
    with PeakMemory() as later:
        pass
    assert process_peak_mb() > before + 300 - SLACK
    assert later.mb <= process_peak_mb()


def test_an_outer_stretch_knows_what_an_inner_one_saw() -> None:
    before = resident()
    with PeakMemory() as outer:
        use(150)
        with PeakMemory() as inner:
            use(60)
    assert outer.mb == pytest.approx(before + 150, abs=SLACK)
    assert inner.mb == pytest.approx(before + 60, abs=SLACK)


def test_stretches_of_two_threads_do_not_lose_each_others_peaks() -> None:
    peaks, together = [], Barrier(2)

    def first() -> None:
        with PeakMemory() as peak:
            use(150)
            together.wait()
            together.wait()
        peaks.append(peak.mb)

    before = resident()
    thread = Thread(target=first)
    thread.start()
    together.wait()
    with PeakMemory():  # resets the mark while the other block is measured
        pass
    together.wait()
    thread.join()
    assert peaks == [pytest.approx(before + 150, abs=SLACK)]


def test_a_failure_within_ends_the_watch() -> None:
    with pytest.raises(KeyError), PeakMemory() as peak:
        raise KeyError
    assert peak.mb > 1
    assert not memory._active


@pytest.fixture
def no_reset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A system on which the mark cannot be reset."""
    missing = tmp_path / "missing" / "clear_refs"
    monkeypatch.setattr(memory, "_reset_mark", partial(memory._reset_mark, path=missing))


@pytest.mark.usefixtures("no_reset")
def test_without_a_reset_the_peak_is_sampled() -> None:
    before = resident()
    use(400)
    with PeakMemory() as peak:
        use(100)
    assert peak.sampled
    assert peak.mb == pytest.approx(before + 100, abs=SLACK)


@pytest.mark.usefixtures("no_reset")
def test_without_a_reset_a_mark_that_rises_tells_the_peak_all_the_same() -> None:
    excess = process_peak_mb() - resident() + 50
    with PeakMemory() as peak:
        use(max(excess, 0))
    assert peak.mb == pytest.approx(process_peak_mb(), abs=1.0)  # the system has two counts of resident memory


def test_without_a_mark_the_system_is_asked_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "status_bytes", partial(memory.status_bytes, path=tmp_path / "missing"))
    assert memory._high_water() / 1e6 > resident() / 2
