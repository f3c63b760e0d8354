"""Environments from other packages, adapted for the agent. Each module's docstring names the pip extra that it requires."""
