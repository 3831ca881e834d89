"""What the reference models cost elsewhere: JAGS and PyMC."""
