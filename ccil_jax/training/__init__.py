"""From an agent to a finished run: the compiled program of all runs, the loop around it, and checkpoints."""
