"""What every stage stands on and none is about: failures, files, logs, progress, memory, threads, plug-ins."""
