"""Learnt policies at work: evaluation in our simulators and the original ones, and files for other programs."""
