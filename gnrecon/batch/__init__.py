"""Many scans, each reconstructed in a process of its own, so that whatever befalls one of them costs that one only."""
