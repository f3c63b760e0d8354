"""How the agent plays environments that are not its own, beside the exact optimum, its planner on true models, PPO and DQN."""
