"""Which candidate terms: screening, forward selection, moves, model probabilities, experiment design."""
