"""What is left of networks after pruning (the paper's section 5)."""
