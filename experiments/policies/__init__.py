"""Learnt policies outside JAX: in the original simulators, and as files for other programs."""
