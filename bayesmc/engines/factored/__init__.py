"""Filters whose belief is a product of small tables: Boyen and Koller's, and the factored frontier."""
