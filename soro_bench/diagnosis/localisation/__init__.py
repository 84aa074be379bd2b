"""Where an unknown input acts: test inputs, unknown-input estimation, ranking of locations."""
