"""Why a simulation and a recording differ: docs/explanation/method.md."""
