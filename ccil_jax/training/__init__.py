"""From an agent to a finished run: the compiled program over seeds, its checkpoints, and the loop that logs."""
