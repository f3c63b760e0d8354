"""The studies, each of which is run by a command in the parent folder."""

from pathlib import Path

TEMPLATES = Path(__file__).parent / "templates"
"""Folder of the page templates."""
