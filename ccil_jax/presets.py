"""Named sets of hyperparameters, the `--preset` of the launchers. What a preset does not say has `Config`'s default.

What it says of fields that the chosen method does not read is left out: see `Config.from_preset`.
"""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # Table 1 says "1 discriminator update" for 3 policy steps. A single gradient step on the whole batch is too slow to
    # follow the policy: on Swimmer both went round in circles. So the update is one pass in minibatches. With that many
    # gradient steps the discriminator separates the classes completely where that is easy (HalfCheetah), and its reward
    # no longer tells better from worse. So it has a gradient penalty.
    "paper": {},
    # Begins with a clone and keeps the demonstrations in the policy's objective, so that little of the clone is lost;
    # the simulator adds what cloning cannot know (docs/ablations.md). Critics that see sharp edges, with targets
    # of their own, let the cost's advantages lean on them: without that no multiplier lowered the cost of PointGoal1.
    # An average of the policies is judged, in which the noise of single steps cancels, and it acts with its modes,
    # because most falls come from the noise of single actions. Gaps relative to the limit and cost advantages of unit
    # deviation let one multiplier rate suit tasks of any cost.
    "default": {
        "env_steps": 300_000,
        "batch_size": 4000,
        "generator_steps": 1,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "cost_gae_lambda": 0.5,
        "policy_average": "polynomial_decay",
        "evaluated_action": "mode",
        "critic_intervals": 16,
        "critic_target": "td_lambda",
        "mirrored_demonstrations": "symmetric_tasks",
        "action_likelihood": "censored",
        "cloning_updates": 20_000,
        "cloning_selection": "one_standard_error",
        "warmup_iterations": 5,
        "cloning_weight": None,
        "standardize_cost_advantage": True,
        "gate": "episode",
        "initial_multiplier": 0.0,
        "multiplier_max": 10.0,
        "multiplier_update": "sgd",
        "multiplier_learning_rate": 0.5,
        "gap_unit": "limit",
        "outer_loss": "lagrangian",
        "meta_update": "sgd",
        "meta_learning_rate": 1.0,
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
    # What the authors' code does: Adam on xi for both steps of the multiplier, CVAG's decision for each episode, a
    # value of 0 beyond a time limit. That code counts the steps of one batch in three, so its 1e7 steps are 3e7 here.
    "authors": {
        "meta_gradient": "direct",
        "gate": "episode",
        "bootstrap_at_truncation": False,
        "discriminator_minibatch_size": 2000,
        "discriminator_regularizer": "none",
    },
    # No discriminator has to follow the policy, so an iteration has one larger batch and a wider trust region. What
    # matters most is the horizon: with a discount of 0.99 Hopper learns to run, and to fall after 500 steps. The gap
    # relative to the limit and cost advantages of unit deviation bring the multiplier's rates of the tasks together, if
    # not to one number: docs/tasks.md says where a slower one, or a first multiplier above 0, is worth most.
    "expert": {
        "env_steps": 3_000_000,
        "num_envs": 32,
        "batch_size": 8000,
        "generator_steps": 1,
        "max_kl": 0.02,
        "gamma": 0.995,
        "action_likelihood": "censored",
        "normalize_values": True,
        "standardize_cost_advantage": True,
        "initial_multiplier": 0.0,
        "multiplier_update": "sgd",
        "multiplier_learning_rate": 0.05,
        "gap_unit": "limit",
    },
    # Costs are rare in these tasks (some 25 visits of a hazard in 20,000 steps), hence large batches. What matters most
    # is a cost critic that sees where a hazard begins (docs/ablations.md): with intervals for the critics and cost
    # advantages that lean on them, CarGoal1's return passes 21 after 1.3 million steps, at a cost of 13.
    "safety_gym_expert": {
        "env_steps": 4_000_000,
        "num_envs": 32,
        "batch_size": 20_000,
        "generator_steps": 1,
        "max_kl": 0.02,
        "gamma": 0.99,
        "gae_lambda": 0.9,
        "cost_gae_lambda": 0.5,
        "action_likelihood": "censored",
        "critic_intervals": 16,
        "critic_target": "td_lambda",
        "standardize_cost_advantage": True,
        "initial_multiplier": 0.0,
        "multiplier_update": "sgd",
        "multiplier_learning_rate": 0.1,
        "gap_unit": "limit",
    },
    "bc": {
        "method": "bc",
        "action_likelihood": "censored",
        "mirrored_demonstrations": "symmetric_tasks",
        "cloning_updates": 20_000,
        "cloning_selection": "one_standard_error",
        "policy_average": "polynomial_decay",
        "evaluated_action": "mode",
    },
    # As published, except for the length: 60,000 steps with as many updates were enough on HalfCheetah.
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
        "evaluated_action": "mode",
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
