"""The drawings of a report that move: a policy's episode as an animation."""
