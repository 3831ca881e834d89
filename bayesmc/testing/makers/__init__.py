"""Random nets, templates, factor graphs, distributions and weights: by seed, or as Hypothesis strategies."""
