"""Measurements of speed and quality against the best of others, and the oracles the tests compare with."""
