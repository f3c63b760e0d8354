"""Comparison of agents on any environment: returns of whole episodes, baselines, confidence intervals and a results page."""
