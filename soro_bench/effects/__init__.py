"""Physics that a model leaves out: laws by name, at ports of any MuJoCo model. docs/reference/effects.md lists them."""
