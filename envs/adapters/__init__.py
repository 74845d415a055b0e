"""Our tasks for other libraries' learners, and other libraries' tasks for ours.

* `GymnasiumEnv(env)`: ours as a `gymnasium.Env`.
* `GymnasiumVectorEnv(env, num_envs)`: many copies of ours as a `gymnasium.vector.VectorEnv`.
* `to_brax(env)`: ours as a `brax.envs.Env`.
* `FromBrax(env, cost)`: a Brax environment, or one of like form (MuJoCo Playground), with a cost function, as ours.
"""

from envs.adapters.brax_env import FromBrax, to_brax
from envs.adapters.gymnasium_env import GymnasiumEnv, GymnasiumVectorEnv

__all__ = ["FromBrax", "GymnasiumEnv", "GymnasiumVectorEnv", "to_brax"]
