"""The environments that the studies use, and their exact rules where these are known."""
