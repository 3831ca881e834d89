"""Independent draws that are weighted, or accepted: likelihood weighting, importance, rejection."""
