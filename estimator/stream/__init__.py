"""The estimator as a process that runs for hours: receiving threads, ordering, sensing process, graph process."""
