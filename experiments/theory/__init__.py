"""Theorem 1 of the paper, checked exactly on small random processes."""
