"""Physics that a model leaves out: laws by name, at locations of any MuJoCo model (docs/reference/effects.md)."""
