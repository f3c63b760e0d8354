"""Measurements: evaluation in batches, statistics, baselines, the comparison of agents and its report."""
