"""What is learned from how many environment steps: returns, coverage and error of the model."""
