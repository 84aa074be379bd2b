"""From recordings to a fit: the problem, data quality, discretisation error, MAP fit, posterior covariance."""
