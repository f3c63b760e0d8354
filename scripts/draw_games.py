"""Draws the README's picture of the three games.

python scripts/draw_games.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import matplotlib as mpl
import tyro

import mbagent_envs
from mbagent_envs.references import reference_policy

mpl.use("Agg")

from matplotlib import pyplot as plt

TITLES = {
    "mbagent/GeyserRunner-v0": "GeyserRunner: right pays, geysers hurt",
    "mbagent/Maneuverer-v0": "Maneuverer: reach the target",
    "mbagent/FlierCatcher-v0": "FlierCatcher: meet the fliers",
}


@dataclass(frozen=True)
class Args:
    """Draw the three games, each after some steps of its reference player."""

    output: Path = Path("docs/images/games.png")
    """File of the picture."""
    steps: int = 31
    """Steps played before the picture is drawn."""
    seed: int = 8
    """Which episode."""


def main(args: Args) -> None:
    """Draws and saves the picture."""
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), width_ratios=(1.6, 1.0, 1.6), layout="constrained")
    for axis, env_id in zip(axes, mbagent_envs.ENV_IDS, strict=True):
        env = gym.make(env_id, render_mode="rgb_array")
        policy = reference_policy(env.get_wrapper_attr("game"))
        assert policy is not None
        obs, _ = env.reset(seed=args.seed)
        for _ in range(args.steps):
            obs, *_ = env.step(int(policy(obs[None])[0]))
        axis.imshow(env.render())
        axis.set_title(TITLES[env_id], fontsize=9)
        axis.set_axis_off()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.output, dpi=80)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
