"""Planners: Monte Carlo tree search, two kinds of it, flat Monte Carlo, and value iteration on the reachable machine."""
