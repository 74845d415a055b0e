"""Cost-constrained imitation, solved exactly in NumPy and float64, on decision processes with few states and actions.

With occupancies rho(s, a) = (1 - gamma) sum_t gamma^t P(s_t = s, a_t = a), which sum to 1, and expectations under them,
the problem of Theorem 1 is convex:

    minimise over rho   2 JS(rho, rho_E) - log 4 + max over lambda of lambda (J(rho) - J_E) - beta H(rho)

where J is the expected cost and H the causal entropy. Arrays are [S, A] unless said otherwise.
"""

import dataclasses

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class Process:
    """A constrained Markov decision process without its reward."""

    transition: Array  # [S, A, S] probabilities of the next state
    initial: Array  # [S]
    cost: Array  # [S, A]
    gamma: float

    def occupancy(self, policy: Array) -> Array:
        """rho of a policy [S, A]."""
        moves = np.einsum("sa,sat->st", policy, self.transition)
        states = np.linalg.solve(np.eye(len(moves)) - self.gamma * moves.T, (1 - self.gamma) * self.initial)
        return states[:, None] * policy

    def episode_cost(self, rho: Array) -> float:
        """J: the expected cost of a step."""
        return float(np.sum(rho * self.cost))

    def flow(self) -> tuple[Array, Array]:
        """M [S, S * A] and b [S] of the flow constraints of an occupancy, M rho = b: what flows in flows out."""
        num_states, num_actions, _ = self.transition.shape
        out = np.repeat(np.eye(num_states), num_actions, axis=1)
        return out - self.gamma * self.transition.reshape(-1, num_states).T, (1 - self.gamma) * self.initial


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solution:
    """The optimum of a learner."""

    rho: Array
    multiplier: float
    value: float  # of the objective, with the term of the multiplier


def policy_of(rho: Array) -> Array:
    """The only policy with this occupancy (Syed, Bowling and Schapire 2008)."""
    return rho / rho.sum(axis=1, keepdims=True)


def entropy(rho: Array) -> float:
    """Causal entropy of the occupancy's policy, nats per step; strictly concave (Ho and Ermon 2016, lemma 3.1)."""
    return float(-np.sum(rho * np.log(policy_of(rho))))


def divergence(rho: Array, expert: Array) -> float:
    """2 JS(rho, expert) - log 4, which is the maximum over D of E_rho[log D] + E_expert[log(1 - D)]."""
    return float(np.sum(rho * np.log(rho / (rho + expert))) + np.sum(expert * np.log(expert / (rho + expert))))


def best_discriminator(rho: Array, expert: Array) -> Array:
    """The maximiser D* = rho / (rho + expert): 1 on the learner."""
    return rho / (rho + expert)


def random_process(random: np.random.Generator, num_states: int = 5, num_actions: int = 3) -> Process:
    """Transitions and first states are drawn from a simplex, costs uniformly from [0, 1]."""
    return Process(
        transition=random.dirichlet(np.ones(num_states), (num_states, num_actions)),
        initial=random.dirichlet(np.ones(num_states)),
        cost=random.uniform(size=(num_states, num_actions)),
        gamma=0.9,
    )


def learner(process: Process, expert: Array, beta: float, multiplier: float) -> Solution:
    """The minimum over rho for one multiplier, by Newton's method on the flow constraints.

    The entropy's slope is infinite where an occupancy vanishes, so the minimum lies inside and no bound is needed.
    """
    matrix, right = process.flow()
    num_states, num_actions = expert.shape
    groups = np.kron(np.eye(num_states), np.ones((num_actions, num_actions)))  # 1 where two pairs share a state

    def value(rho: Array) -> float:
        excess = process.episode_cost(rho) - process.episode_cost(expert)
        return divergence(rho, expert) + multiplier * excess - beta * entropy(rho)

    rho = process.occupancy(np.full(expert.shape, 1 / num_actions))
    for _ in range(200):
        states = rho.sum(axis=1, keepdims=True)
        gradient = np.log(rho / (rho + expert)) + multiplier * process.cost + beta * np.log(rho / states)
        curvature = np.diag((expert / (rho * (rho + expert)) + beta / rho).ravel())
        curvature -= beta * groups / np.repeat(states, num_actions)
        kkt = np.block([[curvature, matrix.T], [matrix, np.zeros((num_states, num_states))]])
        residual = np.concatenate([-gradient.ravel(), right - matrix @ rho.ravel()])
        step = np.linalg.solve(kkt, residual)[: rho.size].reshape(rho.shape)
        decrease = -float(np.sum(gradient * step))
        length = min(1.0, 0.99 / max(1e-300, float(np.max(-step / rho))))
        # Near the minimum the values differ only by rounding errors and cannot be compared; there a full step is right.
        while decrease > 1e-12 and value(rho + length * step) > value(rho) - 1e-4 * length * decrease:
            length /= 2
        rho = rho + length * step
        if decrease < 1e-24:
            break
    return Solution(rho=rho, multiplier=multiplier, value=value(rho))


def saddle(process: Process, expert: Array, beta: float, bound: float = np.inf) -> Solution:
    """The learner with its multiplier in [0, bound]: the one at which J = J_E, or an end of the interval."""

    def excess(multiplier: float) -> float:
        rho = learner(process, expert, beta, multiplier).rho
        return process.episode_cost(rho) - process.episode_cost(expert)

    if excess(0.0) <= 0:
        return learner(process, expert, beta, 0.0)
    low, high = 0.0, 1.0
    while high < bound and excess(high) > 0:
        low, high = high, 2 * high
    if high >= bound:
        high = bound
        if excess(bound) > 0:
            return learner(process, expert, beta, bound)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return learner(process, expert, beta, (low + high) / 2)


def soft_optimum(process: Process, reward: Array, beta: float) -> tuple[Array, float]:
    """The policy that maximises E[reward] + beta H, and the maximum, by soft value iteration, without convex solver."""
    value = np.zeros(len(process.initial))
    for _ in range(2000):
        q = reward + process.gamma * process.transition @ value
        largest = q.max(axis=1, keepdims=True)
        new = (largest + beta * np.log(np.exp((q - largest) / beta).sum(axis=1, keepdims=True)))[:, 0]
        converged = np.max(np.abs(new - value)) < 1e-14
        value = new
        if converged:
            break
    policy = np.exp((q - value[:, None]) / beta)
    return policy / policy.sum(axis=1, keepdims=True), float((1 - process.gamma) * process.initial @ value)


def dual_value(process: Process, expert: Array, beta: float, discriminator: Array, multiplier: float) -> float:
    """The dual function: the minimum over policies of the objective of Theorem 1, for a fixed D and multiplier."""
    reward = -np.log(discriminator) - multiplier * process.cost
    constant = np.sum(expert * np.log1p(-discriminator)) - multiplier * process.episode_cost(expert)
    return float(constant) - soft_optimum(process, reward, beta)[1]


def advantages(process: Process, policy: Array, reward: Array) -> Array:
    """Q - V of a policy."""
    moves = np.einsum("sa,sat->st", policy, process.transition)
    value = np.linalg.solve(np.eye(len(moves)) - process.gamma * moves, np.sum(policy * reward, axis=1))
    q = reward + process.gamma * process.transition @ value
    return q - np.sum(policy * q, axis=1, keepdims=True)


def natural_step(process: Process, policy: Array, reward: Array, size: float) -> Array:
    """A natural policy-gradient step of a softmax policy: pi exp(size advantage), normalised (Kakade 2001)."""
    logits = np.log(policy) + size * advantages(process, policy, reward)
    new = np.exp(logits - logits.max(axis=1, keepdims=True))
    return new / new.sum(axis=1, keepdims=True)
