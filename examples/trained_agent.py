"""An agent trained by PPO (Stable-Baselines3) in an environment of `ded_bench.gym`, as one's own method.

From the folder that holds this file; the second line trains for a quarter of an hour, and writes the weights:

    pip install '.[train,gym,examples]'
    python trained_agent.py
    ded-bench solve --case two-area --method trained_agent:solve --regime TO --limit 3 --out results/mine
    ded-bench online --case two-area --method trained_agent:solve --regime TO --scenarios 3 --out results/mine
"""

import sys
from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.wrappers import FlattenObservation

import ded_bench.gym  # registers the environments
from ded_bench.files.arrays import read_arrays, write_arrays

ENV = "ded_bench/two-area-TO-v0"
FILE = Path(__file__).with_name("trained_agent.safetensors")
#: An action of 1 is this part of the ramp limits, and holds for so many seconds.
PART, HOLD = 0.1, 5


class Held(gymnasium.Wrapper):
    """Repeats an action; the reward is the sum."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gymnasium.spaces.Box(-1 / PART, 1 / PART, env.action_space.shape, np.float32)

    def step(self, action):
        """Go on for HOLD seconds, or to the end."""
        total = 0.0
        for _ in range(HOLD):
            seen, reward, ended, cut, info = self.env.step(PART * action)
            total += reward
            if ended:
                break
        return seen, total, ended, cut, info


def train(steps=40_000, file=FILE, seed=0):
    """Train on the environment's draws; write the network that acts, with the scale of observations in it."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    env = VecNormalize(make_vec_env(lambda: Held(FlattenObservation(gymnasium.make(ENV))), seed=seed))
    small = {"net_arch": [64, 64], "log_std_init": -4.0}  # large ramps explore how machines swing, no more
    smooth = {"use_sde": True, "sde_sample_freq": -1, "policy_kwargs": small}
    agent = PPO(
        "MlpPolicy", env, 3e-4, n_steps=480, batch_size=120, gamma=0.99, seed=seed, verbose=1, **smooth
    )
    agent.learn(steps)
    layers = agent.policy.mlp_extractor.policy_net, agent.policy.action_net
    arrays = [array.detach().numpy() for layer in layers for array in layer.parameters()]
    scale = np.sqrt(env.obs_rms.var + env.epsilon)
    arrays[1] = arrays[1] - arrays[0] @ (env.obs_rms.mean / scale)
    arrays[0] = arrays[0] / scale
    write_arrays(file, {str(i): array.astype(np.float32) for i, array in enumerate(arrays)}, {"env": ENV})
    return agent, env


@cache
def network(file):
    """Weights and biases in turn, from a file of numbers, which executes nothing."""
    arrays, _ = read_arrays(file)
    return [arrays[str(i)] for i in range(len(arrays))]


def act(seen, file=FILE):
    """The agent's action for a flat observation."""
    *hidden, weight, bias = network(file)
    for one, other in zip(hidden[::2], hidden[1::2], strict=True):
        seen = np.tanh(one @ seen + other)
    return np.clip(weight @ seen + bias, -1 / PART, 1 / PART)


@cache
def environment(case, regime):
    """One to play instances in."""
    return Held(FlattenObservation(ded_bench.gym.DispatchEnv(case, regime)))


def solve(instance, regime, case, file=FILE):
    """Answer one instance: the agent plays it, against the plant itself."""
    env, ended = environment(case, regime), False
    seen, _ = env.reset(options={"instance": instance})
    while not ended:
        seen, _, ended, _, info = env.step(act(seen, file))
    return info["schedule"]


if __name__ == "__main__":
    train(*map(int, sys.argv[1:]))
