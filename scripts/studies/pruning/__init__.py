"""Pruned networks and their structure (the paper's section 5)."""
