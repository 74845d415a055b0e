"""The fields of `Config` as keywords, for functions that take some of them: an editor then knows a wrong one.

`tests/test_config.py` compares them with `Config`.
"""

from typing import TypedDict


class Fields(TypedDict, total=False):
    """Any of the fields of `Config`, which says what they mean."""

    method: str
    env_steps: int
    num_envs: int
    batch_size: int
    generator_steps: int
    discriminator_steps: int
    discriminator_minibatch_size: int
    held_out_fraction: float
    hidden_sizes: tuple[int, ...]
    activation: str
    meta_gradient: str
    outer_loss: str
    outer_advantage: str
    held_out_unit: str
    multiplier_update: str
    gap_unit: str
    meta_update: str
    gate: str
    imitation_reward: str
    reward_form: str
    discriminator_regularizer: str
    cg_iterations: int
    fisher_stride: int
    line_search_steps: int
    policy_average: str
    evaluated_action: str
    critic_intervals: int
    critic_target: str
    normalize_values: bool
    critic_epochs: int
    critic_minibatch_size: int
    standardize_cost_advantage: bool
    bootstrap_at_truncation: bool
    action_likelihood: str
    mirrored_demonstrations: str
    cloning_updates: int
    cloning_selection: str
    warmup_iterations: int
    replay_size: int
    updates_per_step: int
    value_loss: str
    max_skipped_updates: int
    gamma: float
    cost_gamma: float | None
    gae_lambda: float
    cost_gae_lambda: float
    critic_lambda: float
    policy_average_power: float
    max_kl: float
    kl_tolerance: float
    cg_damping: float
    critic_learning_rate: float
    discriminator_learning_rate: float
    policy_entropy_coefficient: float
    discriminator_entropy_coefficient: float
    gradient_penalty_coefficient: float
    initial_multiplier: float
    multiplier_learning_rate: float
    meta_learning_rate: float
    outer_penalty: float
    multiplier_max: float
    pid_proportional_gain: float
    pid_integral_gain: float
    pid_derivative_gain: float
    pid_smoothing: float
    actor_learning_rate: float
    target_update_rate: float
    chi2_coefficient: float
    temperature: float | None
    cloning_weight: float | None
    cost_limit: float | None
