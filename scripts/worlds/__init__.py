"""The environments of the studies, with their exact rules if these are known."""
