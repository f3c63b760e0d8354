"""Reward-free exploration: random, persistent, or directed at what was seldom visited."""

from mbagent.exploration.strategies import DirectedExploration, Exploration, PersistentExploration, RandomExploration

__all__ = ["DirectedExploration", "Exploration", "PersistentExploration", "RandomExploration"]
