"""Error bars, goodness of fit, ambiguities, planning."""
