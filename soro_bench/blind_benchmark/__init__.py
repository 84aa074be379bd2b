"""Hidden cases: recordings of simulated "real" robots with hidden physics, and their sealed labels."""
