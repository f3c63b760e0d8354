"""Accuracy of predicted next states on unseen transitions, after given numbers of steps of random play."""
