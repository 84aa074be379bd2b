"""From a recording to a distribution over physical parameters."""
