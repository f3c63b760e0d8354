"""Accuracy of sampled transition probabilities: a replication of the paper's sections 3.3 and 3.4."""
