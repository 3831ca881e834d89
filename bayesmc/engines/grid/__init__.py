"""The histogram filter: beliefs as probabilities of cells."""
