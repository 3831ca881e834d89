"""Linear algebra of Normal laws: precisions with a pattern, covariances by their square roots."""
