"""Many trainings with one command: plan, run what is missing, write an entry for each."""
