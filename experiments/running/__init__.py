"""One training run: its plan, its session, the loop over chunks, its files and checkpoints, and resuming it."""
