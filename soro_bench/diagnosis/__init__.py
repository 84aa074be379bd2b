"""Why a simulation and a recording differ: docs/diagnosis.md."""
