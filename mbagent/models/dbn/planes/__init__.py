"""Planes: models whose parameters are tied over the positions of a board."""
