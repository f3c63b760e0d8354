"""Accuracy of forecasts several steps ahead (the paper's sections 2 and 4.2)."""
