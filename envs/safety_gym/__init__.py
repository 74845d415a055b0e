"""Eight Safety Gym tasks (safety-gymnasium 1.0.0, level 1) in JAX, on any of the physics engines."""
