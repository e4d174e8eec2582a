"""Many scans, each reconstructed in a process of its own, so that whatever befalls one of them costs that one only."""

from gnrecon.batch.job import Limits
from gnrecon.batch.request import Request
from gnrecon.batch.runner import run_batch

__all__ = ["Limits", "Request", "run_batch"]
