"""Speed and quality of planning and of sampling, beside other packages (paper 4.1)."""
