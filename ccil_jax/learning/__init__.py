"""The pieces of one iteration, as pure functions: returns, critics, reward models, the policy step, constraints."""
