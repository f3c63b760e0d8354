"""Settings of all tests."""

from hypothesis import settings

# The same examples in every run: a test fails for what was changed, not by chance.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")
