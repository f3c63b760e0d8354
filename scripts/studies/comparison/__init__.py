"""Comparison of the agent with PPO, DQN and A2C on all games."""
