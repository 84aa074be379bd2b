"""What happened in an episode, and how to look at it."""
