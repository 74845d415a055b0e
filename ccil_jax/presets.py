"""Named sets of hyperparameters, the `--preset` of the launchers. What a preset does not say has `Config`'s default.

What it says of fields that the chosen method does not read is left out: see `Config.from_preset`.
"""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # Table 1 says "1 discriminator update" for 3 policy steps. One full-batch step trails the policy (on Swimmer the
    # two went round in circles), hence minibatches; without a penalty the discriminator then wins outright where the
    # classes part easily (HalfCheetah).
    "paper": {},
    # The best of what docs/ablations.md measures at this length: CVAG's gate by episode, and a multiplier that moves
    # with the size of the gap (CCIL: 74 % of the return instead of 58 on HalfCheetah, 98 instead of 66 on Swimmer).
    "default": {
        "env_steps": 1_500_000,
        "gate": "episode",
        "multiplier_update": "sgd",
        "multiplier_learning_rate": 5e-4,
    },
    # Algorithm 1 line by line: one full-batch step of the discriminator, lambda itself projected to [0, max], and the
    # derivative of line 16 with the policy and its advantages held fixed.
    "printed": {
        "meta_gradient": "direct",
        "multiplier_update": "sgd",
        "meta_update": "sgd",
        "discriminator_minibatch_size": 2000,
        "discriminator_regularizer": "none",
    },
    # What the authors' code does: Adam on xi for both steps of the multiplier, CVAG's gate by episode, no value beyond
    # a time limit. It counts the steps of one batch of the three, so its 1e7 are 3e7 here.
    "authors": {
        "meta_gradient": "direct",
        "gate": "episode",
        "bootstrap_at_truncation": False,
        "discriminator_minibatch_size": 2000,
        "discriminator_regularizer": "none",
    },
    # No discriminator has to keep up with the policy: one larger batch and a wider trust region per iteration.
    "expert": {"env_steps": 2_000_000, "batch_size": 4000, "generator_steps": 1, "max_kl": 0.02, "gamma": 0.99},
    # Costs are rare here (some 25 visits of a hazard in 20,000 steps), so their gradient is mostly noise. Hence large
    # batches, small steps, and a multiplier that slows down as the cost nears its limit: Adam's walks past it. A short
    # lambda for the cost leaves the critic's errors in charge: with 0.8 PointGoal1's cost did not fall at all.
    "safety_gym_expert": {
        "env_steps": 8_000_000,
        "num_envs": 32,
        "batch_size": 20_000,
        "generator_steps": 1,
        "gamma": 0.99,
        "gae_lambda": 0.9,
        "critic_learning_rate": 3e-4,
        "initial_multiplier": 0.0,
        "multiplier_update": "sgd",
        "multiplier_learning_rate": 7e-4,
    },
    "bc": {"method": "bc"},
    # As published, but for the length: 60,000 steps with as many updates sufficed on HalfCheetah.
    "iq_learn": {
        "method": "iq_learn",
        "env_steps": 100_000,
        "num_envs": 4,
        "batch_size": 1000,
        "generator_steps": 1,
        "hidden_sizes": (256, 256),
        "activation": "relu",
        "gamma": 0.99,
        "critic_learning_rate": 3e-4,
        "actor_learning_rate": 3e-5,
        "critic_minibatch_size": 256,
    },
    "tiny": {
        "env_steps": 240,
        "num_envs": 4,
        "batch_size": 40,
        "hidden_sizes": (8, 8),
        "discriminator_minibatch_size": 20,
        "critic_minibatch_size": 10,
        "critic_epochs": 2,
    },
}
