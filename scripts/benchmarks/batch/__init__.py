"""Many scans at a time: what befalls some of them, a batch that is killed, and throughput."""
