"""Returns, coverage and model error as functions of the number of environment steps."""
