"""Planners: value iteration on the reachable MDP, Monte Carlo tree search, and flat Monte Carlo."""
