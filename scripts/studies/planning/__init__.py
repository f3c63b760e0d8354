"""Speed and quality of planning and sampling, compared with other packages (paper 4.1)."""
