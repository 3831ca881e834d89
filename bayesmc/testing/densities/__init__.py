"""Checks of densities that a user wrote."""
