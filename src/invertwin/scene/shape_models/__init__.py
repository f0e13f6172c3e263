"""Shape models: distances, densities, lattices, learned priors."""
