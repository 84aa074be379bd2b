"""Robots that can be diagnosed: those of the suite, and any MJCF model with a mapping file."""
