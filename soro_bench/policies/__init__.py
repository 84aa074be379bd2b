"""Policies as data: no file of them is ever executed or unpickled."""
