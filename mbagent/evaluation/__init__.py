"""Compares agents on any environment: returns of whole episodes, baselines, intervals, and a page that shows them."""
