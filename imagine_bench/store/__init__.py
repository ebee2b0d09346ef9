"""Keep what was measured: files, checkpoints, run folders, bench folders, results."""
