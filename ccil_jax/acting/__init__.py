"""From observations to actions and episodes: networks, distributions, rollouts and evaluation."""
