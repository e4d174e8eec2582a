"""Which CUDA devices there are, so that each job can be given one of them."""

from __future__ import annotations

import os
from collections.abc import Sequence

from gnrecon.batch.job import Job


def cuda_devices(jobs: Sequence[Job]) -> list[str]:
    """Return the devices, as ``CUDA_VISIBLE_DEVICES`` names them, if a job asks for ``cuda``; none otherwise.

    A job that asks for a certain one, such as ``cuda:1``, needs to see them all; then none are handed out.
    """
    wanted = {str(job.options["device"]) for job in jobs}
    if "cuda" not in wanted or any(device.startswith("cuda:") for device in wanted):
        return []
    if visible := os.environ.get("CUDA_VISIBLE_DEVICES"):
        return [name.strip() for name in visible.split(",") if name.strip()]
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]
