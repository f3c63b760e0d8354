"""Reward-free exploration: random, persistent, or directed at rarely visited (state, action) pairs."""

from mbagent.exploration.strategies import DirectedExploration, Exploration, PersistentExploration, RandomExploration

__all__ = ["DirectedExploration", "Exploration", "PersistentExploration", "RandomExploration"]
