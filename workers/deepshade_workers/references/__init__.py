"""Monte Carlo references: a file for each effect."""
