"""Planners: Monte Carlo tree search, flat Monte Carlo, and value iteration on the reachable machine."""
