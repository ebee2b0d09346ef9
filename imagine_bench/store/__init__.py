"""Keep results: files, checkpoints, run folders, bench folders, results."""
