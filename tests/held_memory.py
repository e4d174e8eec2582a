"""Memory of a known size, held and given back, and what is resident, for tests of what gnrecon says of its memory."""

from __future__ import annotations

import gc
import time
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, PAGESIZE, mmap

import numpy as np
import psutil


def use(mb: float) -> None:
    """Hold so much memory, as long as it takes to be seen where the mark cannot be set back, and give it back.

    It comes from the system itself: an allocator may serve it from what earlier tests freed and it kept resident.
    """
    with mmap(-1, max(int(mb * 1e6), 1), flags=MAP_PRIVATE | MAP_ANONYMOUS) as held:
        np.frombuffer(held, dtype=np.uint8)[::PAGESIZE] = 1
        time.sleep(0.25)  # five samples


def resident() -> float:
    """Return what is resident, in MB, having freed what earlier tests left, lest it be given back within a stretch."""
    gc.collect()
    return psutil.Process().memory_info().rss / 1e6
