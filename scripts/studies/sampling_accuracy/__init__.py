"""How accurately models sample transition probabilities: the paper's section 3.3 and 3.4, measured again."""
