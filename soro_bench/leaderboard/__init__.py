"""Fixed evaluations, results as files, and the page that compares them."""
