"""The studies: each measures one thing, and a command in the folder above runs it."""

from pathlib import Path

TEMPLATES = Path(__file__).parent / "templates"
"""Folder of the pages' templates."""
