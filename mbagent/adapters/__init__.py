"""Environments of other packages in a form that the agent takes. Each module needs the extra that it names."""
