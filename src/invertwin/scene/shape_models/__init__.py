"""Shapes as unknowns: distances, densities, lattices, learned priors."""
