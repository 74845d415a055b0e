"""Learners made of these pieces: the on-policy methods, behaviour cloning and IQ-Learn."""
