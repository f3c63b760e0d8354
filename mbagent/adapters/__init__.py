"""Environments of other packages in a form that the agent supports. Each module requires the extra that it names."""
