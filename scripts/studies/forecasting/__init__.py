"""How far ahead models can see (the paper's sections 2 and 4.2)."""
