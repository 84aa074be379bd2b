"""Laws outside the catalogue: found as data, from the input that explains a residual where it acts."""
